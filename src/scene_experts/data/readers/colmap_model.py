"""Reads and writes COLMAP reconstructions, binary and text, with numpy only. 2D tracks are read but
not written."""

from __future__ import annotations

import math
import struct
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath

import numpy as np
from numpy.typing import NDArray

from scene_experts.core.errors import InputError
from scene_experts.core.io import write_bytes
from scene_experts.core.reading.budget import COLMAP
from scene_experts.core.reading.numbers import FARTHEST, usable_rows
from scene_experts.core.reading.source import opening, shorten
from scene_experts.data.lens import COLMAP_MODELS, Lens
from scene_experts.data.readers import colmap_parse as parse
from scene_experts.data.readers.colmap_parse import POINT, ColmapImage


@dataclass(frozen=True)
class Model:
    """A reconstruction: lenses by camera id, registered images and points (P may be 0)."""

    cameras: dict[int, Lens]
    images: tuple[ColmapImage, ...]
    ids: NDArray[np.int64]  # [P]
    xyz: NDArray[np.float64]  # [P, 3]
    rgb: NDArray[np.uint8]  # [P, 3]
    error: NDArray[np.float64]  # [P] mean reprojection error in px, as stored
    observations: dict[int, tuple[NDArray[np.float64], NDArray[np.int64]]] = field(
        default_factory=dict
    )  # image id: xy [n, 2], point id [n]
    points_file: Path | None = None  # where the points are from
    notes: tuple[str, ...] = ()  # what was decided about their colours


def find_models(root: Path) -> list[Path]:
    """Return the folders of the reconstructions in `root`; none if there are none.

    They are those in sparse (numbered ones first, by number) and sparse itself, else the same in
    colmap/sparse, else `root` itself: folders with a file of a reconstruction.
    """
    for name in ("sparse", "colmap/sparse"):
        inside = [p for p in (root / name).iterdir() if not p.name.startswith(".")] if (root / name).is_dir() else []
        inside.sort(key=lambda p: (not p.name.isdecimal(), int(p.name) if p.name.isdecimal() else 0, p.name))
        if found := [p for p in (*inside, root / name) if holds_model(p)]:
            return found
    return [root] if holds_model(root) else []


def holds_model(folder: Path) -> bool:
    """Return whether a folder holds a file of a reconstruction."""
    return any((folder / f"{part}.{kind}").is_file() for part in ("cameras", "images", "points3D") for kind in ("bin", "txt"))


def count_images(folder: Path) -> int:
    """Return how many photographs the reconstruction in `folder` has, 0 if it cannot be read."""
    path = _pick_file(folder, "images")
    try:
        if path is None:
            return 0
        with opening(path, COLMAP) as source:
            if path.suffix == ".txt":
                return sum(1 for _ in parse.read_images_txt(source, False))
            count = int.from_bytes(source.head(8), "little")
            return count if count * parse.SMALLEST_IMAGE <= source.size else 0
    except InputError:
        return 0


def read_model(folder: Path, observations: bool = False, points: bool = True) -> Model:
    """Read the reconstruction in `folder`. Binary files take precedence over text files.

    Without a points3D file, and without `points`, the model has no points. `observations` also
    reads the 2D tracks. Raises InputError if a file is missing, truncated or malformed, if there
    are no cameras or images, and if an image has a pose that is not finite or an unknown camera.
    """
    cameras_file, images_file, points_file = (_pick_file(folder, name) for name in ("cameras", "images", "points3D"))
    for name, found in (("cameras", cameras_file), ("images", images_file)):
        if found is None:
            raise InputError(f"expected {name}.bin or {name}.txt in {folder}, found neither; copy the whole reconstruction there")
    assert cameras_file is not None and images_file is not None
    with opening(cameras_file, COLMAP) as source:
        cameras = dict(parse.read_cameras_bin(source) if cameras_file.suffix == ".bin" else parse.read_cameras_txt(source))
    if not cameras:
        raise InputError(f"expected at least one camera in {cameras_file}, found none; reconstruct the capture again")
    with opening(images_file, COLMAP) as source:
        read = parse.read_images_bin if images_file.suffix == ".bin" else parse.read_images_txt
        rows = list(read(source, observations))
        images = tuple(image for image, _ in rows)
        _check_images(images, cameras, images_file)
    table, notes = read_points(points_file) if points and points_file is not None else (np.empty(0, POINT), [])
    return Model(
        cameras,
        images,
        table["id"].astype(np.int64),
        np.array(table["xyz"], dtype=np.float64),  # copies: torch rejects the strides of a packed record
        np.array(table["rgb"]),
        np.array(table["error"], dtype=np.float64),
        {image.id: (seen["xy"].copy(), seen["point"].copy()) for image, seen in rows if seen is not None},
        points_file,
        tuple(notes),
    )


def read_points(path: Path) -> tuple[NDArray, list[str]]:
    """Return the points [P] of a points3D file as `colmap_parse.POINT`, and notes on their colours.

    Points without a usable position are dropped with a warning. Raises InputError for a damaged
    file.
    """
    notes: list[str] = []
    with opening(path, COLMAP) as source:
        points = parse.read_points_bin(source) if path.suffix == ".bin" else parse.read_points_txt(source, notes)
        return points[usable_rows(points["xyz"], path)], notes


def _pick_file(folder: Path, name: str) -> Path | None:
    return next((path for kind in ("bin", "txt") if (path := folder / f"{name}.{kind}").is_file()), None)


def _check_images(images: tuple[ColmapImage, ...], cameras: dict[int, Lens], path: Path) -> None:
    if not images:
        raise InputError(f"expected at least one registered image in {path}, found none; reconstruct the capture again")
    for image in images:
        if not PurePosixPath(image.name).name:
            raise InputError(f"expected a name for every image, found {image.name!r} for image {image.id} in {path}; restore the file")
        length = math.hypot(*image.quaternion)
        if not 1e-6 <= length <= 1e6 or not all(abs(t) <= FARTHEST for t in image.translation):
            name = shorten(image.name)
            raise InputError(f"expected a finite pose for every image in {path}, found {name} without one; remove that image")
        if image.camera_id not in cameras:
            raise InputError(
                f"expected camera {image.camera_id} of {shorten(image.name)} in {path.parent}, found no such camera; "
                "restore the reconstruction"
            )


def write_model(folder: Path, model: Model, text: bool = False) -> None:
    """Write `model` to `folder` in COLMAP's format, binary by default. 2D tracks, which training
    does not use, are not written."""
    kind, make = (".txt", _to_text) if text else (".bin", _to_binary)
    for name, data in make(model).items():
        write_bytes(folder / f"{name}{kind}", data)


def _encode(name: str) -> bytes:
    return name.encode("utf-8", "surrogateescape")


def _to_binary(model: Model) -> dict[str, bytes]:
    cameras = struct.pack("<Q", len(model.cameras)) + b"".join(
        struct.pack(f"<iiQQ{len(c.params)}d", key, COLMAP_MODELS.index(c.model), c.width, c.height, *c.params)
        for key, c in model.cameras.items()
    )
    images = struct.pack("<Q", len(model.images)) + b"".join(
        struct.pack("<i7di", i.id, *i.quaternion, *i.translation, i.camera_id) + _encode(i.name) + b"\0" + bytes(8) for i in model.images
    )
    points = np.zeros(len(model.xyz), POINT)
    points["id"], points["xyz"], points["rgb"], points["error"] = model.ids, model.xyz, model.rgb, model.error
    return {"cameras": cameras, "images": images, "points3D": struct.pack("<Q", len(points)) + points.tobytes()}


def _to_text(model: Model) -> dict[str, bytes]:
    cameras = ["# CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]"]
    cameras += [f"{key} {c.model} {c.width} {c.height} " + " ".join(map(repr, c.params)) for key, c in model.cameras.items()]
    images = ["# IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, CAMERA_ID, NAME", "# POINTS2D[] as (X, Y, POINT3D_ID)"]
    for i in model.images:
        images += [" ".join([str(i.id), *map(repr, (*i.quaternion, *i.translation)), str(i.camera_id), i.name]), ""]
    points = ["# POINT3D_ID, X, Y, Z, R, G, B, ERROR, TRACK[] as (IMAGE_ID, POINT2D_IDX)"]
    for key, xyz, rgb, error in zip(model.ids.tolist(), model.xyz.tolist(), model.rgb.tolist(), model.error.tolist()):
        points.append(" ".join([str(key), *map(repr, xyz), *map(str, rgb), repr(error)]))
    parts = {"cameras": cameras, "images": images, "points3D": points}
    return {name: _encode("\n".join(lines) + "\n") for name, lines in parts.items()}
