"""Reads and writes COLMAP reconstructions, binary and text, with numpy only. 2D tracks are read but
not written.

Binary layouts are little endian. cameras: u64 count, then i32 id, i32 model, u64 width, u64 height,
f64 parameters. images: u64 count, then i32 id, f64 quaternion (wxyz), f64 translation (world to
camera), i32 camera, zero-terminated name, u64 n, n x (f64 x, f64 y, i64 point). points3D: u64
count, then u64 id, f64 xyz, u8 rgb, f64 error, u64 n, n x (i32 image, i32 index).
"""

from __future__ import annotations

import math
import struct
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath

import numpy as np
from numpy.typing import NDArray

from scene_experts.core.errors import InputError
from scene_experts.core.io import write_bytes
from scene_experts.core.reading.budget import COLMAP
from scene_experts.core.reading.numbers import FARTHEST, expect_range, usable_rows
from scene_experts.core.reading.source import Source, opening, shorten
from scene_experts.data.lens import MODELS, Lens

_NAMES = tuple(MODELS)
_POINT = np.dtype([("id", "<u8"), ("xyz", "<f8", 3), ("rgb", "u1", 3), ("error", "<f8"), ("length", "<u8")])  # 51 bytes, packed
_OBSERVATION = np.dtype([("xy", "<f8", 2), ("point", "<i8")])


@dataclass(frozen=True)
class ColmapImage:
    """A registered image: world-to-camera quaternion (w, x, y, z) and translation, and the id of
    its camera."""

    id: int
    name: str
    quaternion: tuple[float, float, float, float]
    translation: tuple[float, float, float]
    camera_id: int

    def world_to_cam(self) -> NDArray[np.float64]:
        """Return the world-to-camera matrix [4, 4] float64, OpenCV axes."""
        w, x, y, z = np.asarray(self.quaternion) / np.linalg.norm(self.quaternion)
        out = np.eye(4)
        out[:3, :3] = [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
        out[:3, 3] = self.translation
        return out


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


def find_model(root: Path) -> Path | None:
    """Return the folder of the reconstruction in `root`, or None.

    It is the first of sparse/0, sparse, colmap/sparse/0, colmap/sparse and `root` itself that holds
    a file of a reconstruction.
    """
    for name in ("sparse/0", "sparse", "colmap/sparse/0", "colmap/sparse", "."):
        folder = root / name
        if any((folder / f"{part}.{kind}").is_file() for part in ("cameras", "images", "points3D") for kind in ("bin", "txt")):
            return folder
    return None


def read_model(folder: Path, observations: bool = False) -> Model:
    """Read the reconstruction in `folder`. Binary files take precedence over text files.

    Without a points3D file the model has no points. `observations` also reads the 2D tracks.
    Raises InputError if a file is missing, truncated or malformed, if there are no cameras or
    images, and if an image has a pose that is not finite or an unknown camera.
    """
    cameras_file, images_file, points_file = (_pick_file(folder, name) for name in ("cameras", "images", "points3D"))
    for name, found in (("cameras", cameras_file), ("images", images_file)):
        if found is None:
            raise InputError(f"expected {name}.bin or {name}.txt in {folder}, found neither; copy the whole reconstruction there")
    assert cameras_file is not None and images_file is not None
    with opening(cameras_file, COLMAP) as source:
        cameras = dict(_read_cameras_bin(source) if cameras_file.suffix == ".bin" else _read_cameras_txt(source))
    if not cameras:
        raise InputError(f"expected at least one camera in {cameras_file}, found none; reconstruct the capture again")
    with opening(images_file, COLMAP) as source:
        rows = list(_read_images_bin(source, observations) if images_file.suffix == ".bin" else _read_images_txt(source, observations))
        images = tuple(image for image, _ in rows)
        _check_images(images, cameras, images_file)
    points = np.empty(0, _POINT)
    if points_file is not None:
        with opening(points_file, COLMAP) as source:
            points = _read_points_bin(source) if points_file.suffix == ".bin" else _read_points_txt(source)
            points = points[usable_rows(points["xyz"], points_file)]
    return Model(
        cameras,
        images,
        points["id"].astype(np.int64),
        np.array(points["xyz"], dtype=np.float64),  # copies: torch rejects the strides of a packed record
        np.array(points["rgb"]),
        np.array(points["error"], dtype=np.float64),
        {image.id: (seen["xy"].copy(), seen["point"].copy()) for image, seen in rows if seen is not None},
    )


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


class _Bytes:
    """A cursor over the bytes of a file. Reading past the end raises an InputError that names the
    file."""

    def __init__(self, source: Source, smallest: int) -> None:
        self.path, self.data, self.at = source.path, source.read(), 0
        (self.count,) = self.take("<Q")
        if self.count * smallest > len(self.data):
            raise self.truncated_error()

    def truncated_error(self) -> InputError:
        return InputError(f"expected a complete COLMAP file at {self.path}, found only its first {len(self.data)} bytes; copy it again")

    def take(self, layout: str) -> tuple:
        """Unpack the next values, as `struct` describes them."""
        start, self.at = self.at, self.at + struct.calcsize(layout)
        if self.at > len(self.data):
            raise self.truncated_error()
        return struct.unpack_from(layout, self.data, start)

    def text(self) -> str:
        """Return the next zero-terminated string."""
        end = self.data.find(b"\0", self.at)
        if end < 0:
            raise self.truncated_error()
        start, self.at = self.at, end + 1
        return self.data[start:end].decode("utf-8", "surrogateescape")

    def skip(self, size: int) -> int:
        """Skip `size` bytes and return where they start."""
        start, self.at = self.at, self.at + size
        if self.at > len(self.data):
            raise self.truncated_error()
        return start


def _read_cameras_bin(source: Source) -> Iterator[tuple[int, Lens]]:
    file = _Bytes(source, 24)
    for _ in range(file.count):
        key, model, width, height = file.take("<iiQQ")
        if not 0 <= model < len(_NAMES):
            raise InputError(
                f"expected a camera model between 0 and {len(_NAMES) - 1} ({', '.join(_NAMES)}), found {model} for camera {key} "
                f"in {source.path}; "
                f"convert the reconstruction to one of those"
            )
        name = _NAMES[model]
        yield key, _make_lens(source.path, key, name, width, height, file.take(f"<{len(MODELS[name])}d"))


def _make_lens(path: Path, key: int, model: str, width: int, height: int, params: tuple[float, ...]) -> Lens:
    try:
        return Lens(model, width, height, params)
    except InputError as error:
        raise InputError(f"camera {key} of {path}: {error}") from None


def _read_images_bin(source: Source, observations: bool) -> Iterator[tuple[ColmapImage, NDArray | None]]:
    file = _Bytes(source, 73)
    for _ in range(file.count):
        key, qw, qx, qy, qz, tx, ty, tz, camera = file.take("<i7di")
        name = file.text()
        (n,) = file.take("<Q")
        start = file.skip(n * _OBSERVATION.itemsize)
        seen = np.frombuffer(file.data, _OBSERVATION, n, start) if observations else None
        yield ColmapImage(key, name, (qw, qx, qy, qz), (tx, ty, tz), camera), seen


def _read_points_bin(source: Source) -> NDArray:
    file = _Bytes(source, _POINT.itemsize)
    data, at, size, length = file.data, file.at, _POINT.itemsize, struct.Struct("<Q").unpack_from
    heads = bytearray()
    try:
        for _ in range(file.count):  # records differ in length, so each is located in turn; tracks are skipped
            heads += data[at : at + size]
            at += size + 8 * length(data, at + size - 8)[0]
    except struct.error:
        raise file.truncated_error() from None
    if at > len(data):
        raise file.truncated_error()
    points = np.frombuffer(heads, _POINT)
    points["error"][~np.isfinite(points["error"])] = -1  # unknown, as COLMAP writes it
    return points


def _read_lines(source: Source) -> list[str]:
    text = source.read().decode("utf-8", "surrogateescape").replace("\r\n", "\n").replace("\r", "\n")
    return [line for line in text.split("\n") if not line.startswith("#")]


def _bad_line_error(path: Path, line: str) -> InputError:
    return InputError(f"expected a line of a COLMAP {path.name} in {path}, found {line[:60]!r}; restore the file")


def _read_cameras_txt(source: Source) -> Iterator[tuple[int, Lens]]:
    for line in filter(str.strip, _read_lines(source)):
        parts = line.split()
        try:
            key, model, width, height = int(parts[0]), parts[1], int(parts[2]), int(parts[3])
            params = tuple(float(p) for p in parts[4:])
        except (ValueError, IndexError):
            raise _bad_line_error(source.path, line) from None
        yield key, _make_lens(source.path, key, model, width, height, params)


def _read_images_txt(source: Source, observations: bool) -> Iterator[tuple[ColmapImage, NDArray | None]]:
    lines = iter(_read_lines(source))
    for line in lines:  # two lines per image; the second lists its observations and may be empty
        if not line.strip():
            continue
        parts, second = line.split(maxsplit=9), next(lines, "")
        try:
            q, t = [float(p) for p in parts[1:5]], [float(p) for p in parts[5:8]]
            image = ColmapImage(int(parts[0]), parts[9].strip(), (q[0], q[1], q[2], q[3]), (t[0], t[1], t[2]), int(parts[8]))
        except (ValueError, IndexError):
            raise _bad_line_error(source.path, line) from None
        try:
            float((second.rsplit(maxsplit=1) or ["0"])[-1])  # the next image, read as observations, would be lost
            seen = _parse_observations(second) if observations else None
        except ValueError:
            raise InputError(
                f"expected the observations of {shorten(image.name)} in {source.path} in the line after it (an empty line for none), found "
                f"{second[:60]!r}; restore the file"
            ) from None
        yield image, seen


def _parse_observations(line: str) -> NDArray:
    numbers = np.array(line.split(), dtype=np.float64).reshape(-1, 3)
    out = np.empty(len(numbers), _OBSERVATION)
    out["xy"], out["point"] = numbers[:, :2], numbers[:, 2]
    return out


def _read_points_txt(source: Source) -> NDArray:
    rows = [line.split(maxsplit=8)[:8] for line in _read_lines(source) if line.strip()]
    try:
        numbers = np.array([[float(x) for x in row] for row in rows], dtype=np.float64).reshape(len(rows), 8)
        numbers[:, 7][~np.isfinite(numbers[:, 7])] = -1
        expect_range(numbers[:, 0], "numbers of points")
        expect_range(numbers[:, 4:7], "colours", 0, 255)
    except ValueError:
        raise _bad_line_error(source.path, next((" ".join(row) for row in rows if len(row) < 8), " ".join(rows[0]))) from None
    out = np.empty(len(rows), _POINT)
    out["id"], out["xyz"], out["rgb"], out["error"], out["length"] = numbers[:, 0], numbers[:, 1:4], numbers[:, 4:7], numbers[:, 7], 0
    return out


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
        struct.pack(f"<iiQQ{len(c.params)}d", key, _NAMES.index(c.model), c.width, c.height, *c.params) for key, c in model.cameras.items()
    )
    images = struct.pack("<Q", len(model.images)) + b"".join(
        struct.pack("<i7di", i.id, *i.quaternion, *i.translation, i.camera_id) + _encode(i.name) + b"\0" + bytes(8) for i in model.images
    )
    points = np.zeros(len(model.xyz), _POINT)
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
