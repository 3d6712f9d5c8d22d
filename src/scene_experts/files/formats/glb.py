"""A binary glTF file with KHR_gaussian_splatting, exact; any glTF parser reads the points.

Scales and opacities are stored directly (no logarithms or logits), quaternions as (x, y, z, w),
harmonics in one accessor per coefficient. +Y is up: half a turn about z from ours. COLOR_0 shows
the points in viewers without the extension. Text files (.gltf) with their buffers inside or beside
them are read too, and so are Gaussians that are packed as SPZ.
"""

from __future__ import annotations

import json
import logging
import re
import struct
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from scene_experts.core.io import write_bytes
from scene_experts.core.reading import budget
from scene_experts.core.reading.budget import Damaged
from scene_experts.core.reading.numbers import shown
from scene_experts.core.reading.plain import JSON_STARTS
from scene_experts.core.reading.source import Source, opening
from scene_experts.files.formats.gltf import BIN, JSON, MAGIC, GltfFile
from scene_experts.files.formats.pack import Floats, alphas, logits, tensor, to_bytes, turn, unit_quats, warn_of_transforms
from scene_experts.files.formats.splats import Splats, tell_degree
from scene_experts.files.formats.spz import decode
from scene_experts.files.registry import Format
from scene_experts.geometry.sh import C0

log: logging.Logger = logging.getLogger(__name__)
NAME = "KHR_gaussian_splatting"
SETTINGS = {"kernel": "ellipse", "colorSpace": "srgb_rec709_display", "projection": "perspective", "sortingMethod": "cameraDistance"}
_SPZ = re.compile(r"KHR_(gaussian_splatting_compression_spz(_\d+)?|spz_gaussian_splats_compression|spz_compression)")
"""The extensions that name an SPZ file in a buffer view: the present one, and its earlier names."""
_STILL = {  # the transform of a node, by name, that changes nothing
    "translation": [0, 0, 0],
    "rotation": [0, 0, 0, 1],
    "scale": [1, 1, 1],
    "matrix": [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1],
}
_HALF_TURN = np.array([[0, 0, 0, -1], [0, 0, -1, 0], [0, 1, 0, 0], [1, 0, 0, 0.0]])  # (0, 0, 0, 1) times a quaternion (w, x, y, z)


def write(path: Path, splats: Splats, note: dict[str, Any]) -> None:
    """Write the file; the note goes into asset.extras."""
    columns = _columns(splats)
    views, accessors, parts, offset = [], [], [], 0
    for name, column in columns.items():
        accessor: dict[str, Any] = {
            "bufferView": len(views),
            "componentType": 5121 if column.dtype == np.uint8 else 5126,
            "count": len(column),
            "type": "SCALAR" if column.ndim == 1 else f"VEC{column.shape[1]}",
        }
        if column.dtype == np.uint8:
            accessor["normalized"] = True
        if name == "POSITION" and len(column):
            accessor |= {"min": column.min(0).tolist(), "max": column.max(0).tolist()}
        accessors.append(accessor)
        views.append({"buffer": 0, "byteOffset": offset, "byteLength": column.nbytes, "target": 34962})
        parts.append(column.tobytes())
        offset += column.nbytes
    primitive = {"attributes": {name: i for i, name in enumerate(columns)}, "mode": 0, "extensions": {NAME: SETTINGS}}
    scene = {
        "asset": {"version": "2.0", "generator": "scene-experts", **({"extras": {"scene-experts": note}} if note else {})},
        "extensionsUsed": [NAME],
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [primitive]}],
        "accessors": accessors,
        "bufferViews": views,
        "buffers": [{"byteLength": offset}],
    }
    if not len(splats):  # glTF has no accessors without elements
        scene = {name: scene[name] for name in ("asset", "extensionsUsed", "scene", "scenes")} | {"scenes": [{}]}
    text = json.dumps(scene, separators=(",", ":"), allow_nan=False, default=str).encode()
    text += b" " * (-len(text) % 4)
    chunks = struct.pack("<II", len(text), JSON) + text
    if len(splats):
        chunks += struct.pack("<II", offset, BIN) + b"".join(parts)
    write_bytes(path, struct.pack("<III", MAGIC, 2, 12 + len(chunks)) + chunks)


def read_note(path: Path) -> dict[str, Any]:
    """The note in a file of ours. Raises InputError for a damaged file."""
    with opening(path, budget.GLB) as source:
        found: Any = GltfFile(source).scene
        for name in ("asset", "extras", "scene-experts"):
            found = found.get(name) if isinstance(found, dict) else None
        return found if isinstance(found, dict) else {}


def read(path: Path) -> Splats:
    """The Gaussians of all primitives with the extension, together. Transforms of nodes are not
    applied, and colours of another space are not converted; a warning tells of them.

    Raises InputError for damaged files and for files without such a primitive.
    """
    with opening(path, budget.GLB) as source:
        file = GltfFile(source)
        primitives = [p for mesh in file.scene.get("meshes", []) for p in mesh["primitives"] if _is_gaussians(p)]
        spz = Source(path, budget.SPZ, source.size)  # one budget for all that is packed
        found: list[Splats] = []
        for p in primitives:
            view = _packed_in(p)
            found.append(_read_primitive(file, p["attributes"]) if view is None else _unpack(file.content(view), spz, source.size))
        if not found:
            if NAME in file.scene.get("extensionsUsed", []):
                return _splats(np.zeros((0, 3)), np.zeros((0, 3)), np.zeros((0, 4)), np.zeros(0), np.zeros((0, 1, 3)))
            raise Damaged(f"no primitive with {NAME}")
        if _has_transforms(file.scene):
            warn_of_transforms(path)
        for name in ("kernel", "colorSpace"):
            others = {shown(p["extensions"].get(NAME, {}).get(name, SETTINGS[name])) for p in primitives} - {repr(SETTINGS[name])}
            if others:
                log.warning("%s has Gaussians of the %s %s, which are read as %r", path, name, ", ".join(sorted(others)), SETTINGS[name])
        return Splats.joined(found).checked(path)


def _has_transforms(scene: dict[str, Any]) -> bool:
    """Whether a node with Gaussians, or a node above one, has a transform other than the
    identity."""
    nodes, meshes = scene.get("nodes", []), scene["meshes"]
    above = {child: i for i, node in enumerate(nodes) for child in node.get("children", [])}
    waiting = {i for i, node in enumerate(nodes) if "mesh" in node and _has_gaussians(meshes[node["mesh"]])}
    seen: set[int] = set()
    while waiting:
        seen |= waiting
        if any(nodes[i].get(name, still) != still for i in waiting for name, still in _STILL.items()):
            return True
        waiting = {above[i] for i in waiting if i in above} - seen  # a damaged file may have a circle
    return False


def _has_gaussians(mesh: dict[str, Any]) -> bool:
    return any(_is_gaussians(p) for p in mesh["primitives"])


def _is_gaussians(primitive: dict[str, Any]) -> bool:
    extensions = primitive.get("extensions", {})
    return NAME in extensions or any(_SPZ.fullmatch(name) for name in extensions)


def _unpack(data: bytes, spz: Source, size: int) -> Splats:
    """The Gaussians of an SPZ file inside a file of `size` bytes, in our frame: its own is glTF's by
    half a turn about y."""
    spz.size = size
    return decode(data, spz)


def _packed_in(primitive: dict[str, Any]) -> Any:
    """The buffer view that holds a primitive's Gaussians as SPZ; None for other primitives."""
    extensions = primitive["extensions"]
    every = extensions | extensions.get(NAME, {}).get("extensions", {})
    return next((entry["bufferView"] for name, entry in every.items() if _SPZ.fullmatch(name)), None)


def _columns(splats: Splats) -> dict[str, NDArray[Any]]:
    """The attributes in the frame of glTF, by name."""
    s = turn(splats, "z")
    dc, opacity = s.sh[:, 0].double().numpy(), alphas(s)
    quats = unit_quats(splats) @ _HALF_TURN.T
    columns: dict[str, NDArray[Any]] = {
        "POSITION": s.means.numpy().astype("<f4"),
        "COLOR_0": to_bytes(np.concatenate([dc * C0 + 0.5, opacity[:, None]], 1)),
        f"{NAME}:ROTATION": quats[:, [1, 2, 3, 0]].astype("<f4"),
        f"{NAME}:SCALE": s.log_scales.double().exp().numpy().astype("<f4"),
        f"{NAME}:OPACITY": opacity.astype("<f4"),
    }
    for degree in range(s.degree + 1):
        for i in range(2 * degree + 1):
            columns[f"{NAME}:SH_DEGREE_{degree}_COEF_{i}"] = s.sh[:, degree * degree + i].numpy().astype("<f4")
    return columns


def _splats(means: Floats, scales: Floats, quats: Floats, opacity: Floats, sh: NDArray[Any]) -> Splats:
    """From the frame and units of glTF to ours."""
    wxyz = quats[:, [3, 0, 1, 2]] @ _HALF_TURN  # its transpose undoes the turn
    turned_wrong = turn(
        Splats(tensor(means), tensor(np.log(np.maximum(scales, 1e-30))), tensor(wxyz), tensor(logits(opacity)), tensor(sh)), "z"
    )
    return Splats(turned_wrong.means, turned_wrong.log_scales, tensor(wxyz), turned_wrong.opacity_logit, turned_wrong.sh)


def _read_primitive(file: GltfFile, attributes: dict[str, int]) -> Splats:
    """The Gaussians of one primitive, in our frame."""
    get = lambda name: file.accessor(attributes[name])  # noqa: E731
    degree = max((int(m[1]) for name in attributes if (m := re.fullmatch(NAME + r":SH_DEGREE_(\d)_COEF_0", name))), default=0)
    tell_degree(degree)
    names = [f"{NAME}:SH_DEGREE_{d}_COEF_{i}" for d in range(min(degree, 3) + 1) for i in range(2 * d + 1)]
    small = (get("POSITION"), get(f"{NAME}:SCALE"), get(f"{NAME}:ROTATION"), get(f"{NAME}:OPACITY")[:, 0])
    sh = np.empty((len(small[0]), len(names), 3), np.float32)  # one after the other: most of the memory of a file is here
    for i, name in enumerate(names):
        value = get(name)
        if value.shape != (len(sh), 3):
            raise Damaged(f"{name} of another length or width")
        sh[:, i] = value
    out = (*small, sh)
    shapes = (out[0].shape[1:], out[1].shape[1:], out[2].shape[1:], out[4].shape[2:])
    if len({len(part) for part in out}) != 1 or shapes != ((3,), (3,), (4,), (3,)) or not all(np.isfinite(part).all() for part in out):
        raise Damaged("columns of different lengths or other widths, or values that are not finite")
    return _splats(*out)


def looks_like(path: Path, head: bytes) -> bool:
    """Whether a file is binary glTF, or JSON with the entries of glTF."""
    names = (b'"asset"', b'"accessors"', b'"bufferViews"', b'"meshes"', b'"extensionsUsed"')
    return head.startswith(b"glTF") or path.suffix.lower() == ".gltf" or any(name in head for name in names)


FORMAT = Format(
    suffix=".glb",
    write=write,
    read=read,
    read_note=read_note,
    marks=(b"glTF", *JSON_STARTS),
    looks_like=looks_like,
)
