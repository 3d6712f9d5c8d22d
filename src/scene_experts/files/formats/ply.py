"""3DGS's PLY, exact; every viewer of Gaussians reads it.

Also the parts that other formats use: tables of vertices, and the note in a header. A file of this
family stores one float32 row per vertex in binary_little_endian, scales as logarithms and opacity
as a logit. 3DGS writes f_rest channel by channel. The layouts of anchors and graph points use the
same tables.
"""

from __future__ import annotations

import json
import logging
import math
import re
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from scene_experts.core.errors import InputError
from scene_experts.core.io import write_atomic
from scene_experts.core.reading import budget
from scene_experts.core.reading.plain import parse_json
from scene_experts.core.reading.source import guarding, opening
from scene_experts.core.reading.vertices import HEADER_LIMIT, read_header, read_table
from scene_experts.files.formats.splats import Splats
from scene_experts.files.registry import Format
from scene_experts.geometry.sh import C0

log: logging.Logger = logging.getLogger(__name__)
Columns = dict[str, NDArray[np.generic]]

NOTE_MARK = "scene-experts"
_FILTER = "filter_3D"  # column of Mip-Splatting: by how much each Gaussian is smoothed when it is drawn
_COLOURS = (("red", "green", "blue"), ("r", "g", "b"), ("diffuse_red", "diffuse_green", "diffuse_blue"))
_BRIGHTEST = 8.0  # of colours in [0, 1]; harmonics may be brighter than 1
_THIN = math.log(1e-6)  # third log scale of 2DGS's discs, as its authors propose
_NOTE_LIMIT = 1 << 16  # other readers hold header lines in small buffers
_NAMES = {"i1": "char", "u1": "uchar", "i2": "short", "u2": "ushort", "i4": "int", "u4": "uint", "f4": "float", "f8": "double"}


# --- vertex tables ------------------------------------------------------------------------------------------------------------------------


def read_vertices(path: Path) -> Columns:
    """The scalar properties of the element `vertex`, by name, each [N] in the type of the file;
    ascii and both binary byte orders.

    Raises InputError for a file that is missing, no PLY, cut short, does not begin with vertices,
    or has list properties or unknown types.
    """
    with opening(path, budget.PLY) as source:
        header = read_header(source)
        table = read_table(source, header)
        if not header.ascii:
            return {name: table[name] for name, _ in header.fields}
        with np.errstate(over="ignore", invalid="ignore"):  # callers refuse values that are not finite
            return {name: table[:, i].astype(code) for i, (name, code) in enumerate(header.fields)}


def write_vertices(path: Path, columns: Mapping[str, NDArray[np.generic]], comments: Sequence[str] = ()) -> None:
    """Write columns [N] as the element `vertex` in binary_little_endian, atomically. Raises
    RunError when the disk is full.

    comments: ASCII lines for the header, which readers skip.
    """
    codes = {name: value.dtype.newbyteorder("<").str[1:] for name, value in columns.items()}
    table = np.empty(len(next(iter(columns.values()))), np.dtype([(name, "<" + code) for name, code in codes.items()]))
    for name, value in columns.items():
        table[name] = value
    lines = ["ply", "format binary_little_endian 1.0", *(f"comment {line}" for line in comments), f"element vertex {len(table)}"]
    lines += [f"property {_NAMES[code]} {name}" for name, code in codes.items()] + ["end_header", ""]

    def write_table(temporary: Path) -> None:
        with temporary.open("wb") as stream:
            stream.write("\n".join(lines).encode())
            stream.write(table.data)

    write_atomic(path, write_table)


def floats(value: Tensor) -> list[NDArray[np.float32]]:
    """The columns of a tensor [N, C]."""
    return list(value.detach().cpu().float().numpy().T)


def numbered_columns(prefix: str, value: Tensor) -> Columns:
    """The columns of a tensor [N, C] as prefix0, prefix1, ..."""
    return {f"{prefix}{i}": column for i, column in enumerate(floats(value))}


def numbered_names(columns: Columns, prefix: str) -> list[str]:
    """The columns called prefix + number, sorted by number."""
    found = (name for name in columns if re.fullmatch(re.escape(prefix) + r"[0-9]{1,6}", name))
    return sorted(found, key=lambda name: int(name[len(prefix) :]))


def stack(columns: Columns, names: list[str], path: Path, exact: bool = False) -> Tensor:
    """The named columns as one tensor [N, C] float32; float64 where `exact` and a column is.
    Raises InputError naming the missing ones."""
    absent = [name for name in names if name not in columns]
    if absent or not names:
        raise InputError(f"expected the columns {', '.join(absent) or 'of a scene'} in {path}, found none; write the file again")
    double = exact and any(columns[name].dtype == np.float64 for name in names)
    out = np.empty((len(columns[names[0]]), len(names)), np.float64 if double else np.float32)
    with np.errstate(over="ignore"):  # callers refuse values that are not finite
        for i, name in enumerate(names):
            out[:, i] = columns[name]
    return torch.from_numpy(out)


# --- the note in a header -----------------------------------------------------------------------------------------------------------------


def note_comments(note: Mapping[str, Any]) -> list[str]:
    """The comment lines of a note on how a file was made: "scene-experts {...}" in JSON and ASCII,
    or none for an empty note.

    The longest entries are left out until the line has at most 64 KiB, and `antialias` where it is
    false.
    """
    kept = {name: value for name, value in note.items() if name != "antialias" or value}
    text = json.dumps(kept, allow_nan=False, default=str)
    while len(text) > _NOTE_LIMIT:
        del kept[max(kept, key=lambda name: len(json.dumps(kept[name], default=str)))]
        text = json.dumps(kept, allow_nan=False, default=str)
    return [f"{NOTE_MARK} {text}"] if kept else []


def read_note(path: Path) -> dict[str, Any]:
    """The note in the header of a PLY file; empty where there is none or it cannot be read."""
    start = f"comment {NOTE_MARK} ".encode()
    for line in header(Path(path)).splitlines():
        if line.startswith(start):
            try:
                found = parse_json(line[len(start) :], budget.NOTE)
            except (ValueError, RecursionError):
                return {}
            return found if isinstance(found, dict) else {}
    return {}


def is_antialiased(path: Path) -> bool:
    """Whether the note in the header of a PLY file says that it is drawn with antialiasing."""
    return read_note(path).get("antialias") is True


def header(path: Path) -> bytes:
    """The header of a PLY file, without its end."""
    with opening(path, budget.PLY) as source:
        return source.head(HEADER_LIMIT).split(b"\nend_header", 1)[0]


def property_names(path: Path) -> set[str]:
    """The names of all properties in the header of a PLY file; empty for other files."""
    head = header(path) if path.is_file() else b""
    names = re.findall(rb"^property\s+\S+\s+(\S+)", head, re.M) if head.startswith(b"ply") else []
    return {name.decode("ascii", "replace") for name in names}


# --- Gaussians ----------------------------------------------------------------------------------------------------------------------------


def write(path: Path, splats: Splats, note: Mapping[str, Any], normals: bool = True) -> None:
    """Write 3DGS's file, exact in float32 (248 bytes per Gaussian for degree 3); the note becomes a
    comment in the header."""
    n = len(splats)
    columns: Columns = dict(zip("xyz", floats(splats.means)))
    if normals:
        columns |= {name: np.zeros(n, np.float32) for name in ("nx", "ny", "nz")}
    columns |= numbered_columns("f_dc_", splats.sh[:, 0])
    columns |= numbered_columns("f_rest_", splats.sh[:, 1:].transpose(1, 2).flatten(1))
    columns["opacity"] = floats(splats.opacity_logit[:, None])[0]
    columns |= numbered_columns("scale_", splats.log_scales) | numbered_columns("rot_", splats.quats)
    write_vertices(path, columns, note_comments(note))


def read(path: Path) -> Splats:
    """The Gaussians of 3DGS's file, with two scales (2DGS) or with plain colours too: see
    `as_3dgs`. The smoothing filter of Mip-Splatting is not applied; a warning tells of it. Raises
    InputError for other or damaged files, and for anchors, whose networks are elsewhere."""
    columns = read_vertices(path)
    if "f_offset_0" in columns:
        raise InputError(
            f"expected Gaussians in {path}, found anchors without their networks; give the result folder with point_cloud/iteration_N"
        )
    if not has_gaussians(columns):
        kind = ", a point cloud" if {"x", "y", "z"} <= columns.keys() and not any(name.startswith("f_") for name in columns) else ""
        raise InputError(f"expected Gaussians of 3DGS (f_dc_*) in {path}, found {', '.join(list(columns)[:8])}{kind}; give another file")
    rest_names = numbered_names(columns, "f_rest_")
    if len(rest_names) not in (0, 9, 24, 45):
        raise InputError(f"expected 0, 9, 24 or 45 f_rest columns in {path}, found {len(rest_names)}; write the file again")
    if _FILTER in columns:
        log.warning("%s has a smoothing filter (%s), which is not applied: fuse it (create_fused_ply.py) before the import", path, _FILTER)
    with guarding(path, budget.PLY):
        return splats_in(as_3dgs(columns, path), rest_names, path).checked(path)


def has_gaussians(names: Iterable[str]) -> bool:
    """Whether these are columns of Gaussians: with harmonics, or with opacities, scales and
    colours."""
    found = set(names)
    return "f_dc_0" in found or ({"opacity", "scale_0"} <= found and any(set(colour) <= found for colour in _COLOURS))


def as_3dgs(columns: Columns, path: Path) -> Columns:
    """The columns with those of 3DGS that other programs leave out; a warning tells of each.

    Colours (red, green, blue: integers of 8 or 16 bits, or floats up to 1 or 255, by the largest
    value) become f_dc. Two scales, as in 2DGS, get a third one of 1e-6."""
    added: Columns = {}
    if "f_dc_0" not in columns:
        names = next(colour for colour in _COLOURS if set(colour) <= columns.keys())
        most = max(float(np.fmax.reduce(columns[name], initial=0)) for name in names)
        whole = columns[names[0]].dtype.kind in "iu"
        full = (255 if most <= 255 else 65535) if whole else (1 if most <= _BRIGHTEST else 255)
        added |= {f"f_dc_{i}": (np.asarray(columns[name], np.float64) / full - 0.5) / C0 for i, name in enumerate(names)}
        log.warning("%s has colours (%s) in place of harmonics: they are read as colours from 0 to %d", path, ", ".join(names), full)
    if "scale_2" not in columns and {"scale_0", "scale_1"} <= columns.keys():
        added["scale_2"] = np.full(len(columns["scale_0"]), _THIN, np.float32)
        log.warning("%s has two scales per Gaussian, as 2DGS writes them: its discs are read as Gaussians 1e-6 units thick", path)
    return columns | added


def splats_in(columns: Columns, rest_names: list[str], path: Path) -> Splats:
    """The Gaussians in the columns of 3DGS's file."""
    dc = stack(columns, ["f_dc_0", "f_dc_1", "f_dc_2"], path)[:, None]
    rest = stack(columns, rest_names, path) if rest_names else dc.new_zeros(len(dc), 0)
    return Splats(
        means=stack(columns, ["x", "y", "z"], path, exact=True),
        sh=torch.cat([dc, rest.reshape(len(dc), 3, len(rest_names) // 3).transpose(1, 2)], dim=1),
        opacity_logit=stack(columns, ["opacity"], path)[:, 0],
        log_scales=stack(columns, [f"scale_{i}" for i in range(3)], path),
        quats=stack(columns, [f"rot_{i}" for i in range(4)], path),
    )


FORMAT = Format(
    suffix=".ply",
    write=write,
    read=read,
    marks=(b"ply",),
    looks_like=lambda path, head: b"\nelement chunk " not in header(path),
    antialias=True,
    is_antialiased=is_antialiased,
    read_note=read_note,
)
