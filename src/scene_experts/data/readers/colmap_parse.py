"""Parses the files of COLMAP reconstructions, binary and text, with numpy only.

Binary layouts are little endian. cameras: u64 count, then i32 id, i32 model, u64 width, u64 height,
f64 parameters. images: u64 count, then i32 id, f64 quaternion (wxyz), f64 translation (world to
camera), i32 camera, zero-terminated name, u64 n, n x (f64 x, f64 y, i64 point). points3D: u64
count, then u64 id, f64 xyz, u8 rgb, f64 error, u64 n, n x (i32 image, i32 index).
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from scene_experts.core.errors import InputError
from scene_experts.core.reading.numbers import expect_range, to_size
from scene_experts.core.reading.plain import decode_text
from scene_experts.core.reading.source import Source, shorten
from scene_experts.data.lens import COLMAP_MODELS, MODELS, Lens, unreadable_model
from scene_experts.data.readers.colours import to_bytes

POINT = np.dtype([("id", "<u8"), ("xyz", "<f8", 3), ("rgb", "u1", 3), ("error", "<f8"), ("length", "<u8")])  # 51 bytes, packed
SMALLEST_IMAGE = 73  # bytes of an image without a name and observations
OBSERVATION = np.dtype([("xy", "<f8", 2), ("point", "<i8")])


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


def read_cameras_bin(source: Source) -> Iterator[tuple[int, Lens]]:
    file = _Bytes(source, 24)
    for _ in range(file.count):
        key, model, width, height = file.take("<iiQQ")
        if not 0 <= model < len(COLMAP_MODELS):
            raise InputError(f"camera {key} of {source.path}: {unreadable_model(model)}")
        name = COLMAP_MODELS[model]
        yield key, _make_lens(source.path, key, name, width, height, file.take(f"<{len(MODELS[name])}d"))


def _make_lens(path: Path, key: int, model: str, width: int, height: int, params: tuple[float, ...]) -> Lens:
    if model not in COLMAP_MODELS:
        raise InputError(f"camera {key} of {path}: {unreadable_model(model)}")
    try:
        return Lens(model, width, height, params)
    except InputError as error:
        raise InputError(f"camera {key} of {path}: {error}") from None


def read_images_bin(source: Source, observations: bool) -> Iterator[tuple[ColmapImage, NDArray | None]]:
    file = _Bytes(source, SMALLEST_IMAGE)
    for _ in range(file.count):
        key, qw, qx, qy, qz, tx, ty, tz, camera = file.take("<i7di")
        name = file.text()
        (n,) = file.take("<Q")
        start = file.skip(n * OBSERVATION.itemsize)
        seen = np.frombuffer(file.data, OBSERVATION, n, start) if observations else None
        yield ColmapImage(key, name, (qw, qx, qy, qz), (tx, ty, tz), camera), seen


def read_points_bin(source: Source) -> NDArray:
    file = _Bytes(source, POINT.itemsize)
    data, at, size, length = file.data, file.at, POINT.itemsize, struct.Struct("<Q").unpack_from
    heads = bytearray()
    try:
        for _ in range(file.count):  # records differ in length, so each is located in turn; tracks are skipped
            heads += data[at : at + size]
            at += size + 8 * length(data, at + size - 8)[0]
    except struct.error:
        raise file.truncated_error() from None
    if at > len(data):
        raise file.truncated_error()
    points = np.frombuffer(heads, POINT)
    points["error"][~np.isfinite(points["error"])] = -1  # unknown, as COLMAP writes it
    return points


def _read_lines(source: Source) -> list[str]:
    text = decode_text(source.read()).replace("\r\n", "\n").replace("\r", "\n")
    return [line for line in text.split("\n") if not line.lstrip().startswith("#")]


def _bad_line_error(path: Path, line: str) -> InputError:
    return InputError(f"expected a line of a COLMAP {path.name} in {path}, found {line[:60]!r}; restore the file")


def read_cameras_txt(source: Source) -> Iterator[tuple[int, Lens]]:
    for line in filter(str.strip, _read_lines(source)):
        parts = line.split()
        try:
            key, model, width, height = int(parts[0]), parts[1], to_size(parts[2]), to_size(parts[3])
            params = tuple(float(p) for p in parts[4:])
        except (ValueError, IndexError):
            raise _bad_line_error(source.path, line) from None
        yield key, _make_lens(source.path, key, model, width, height, params)


def read_images_txt(source: Source, observations: bool) -> Iterator[tuple[ColmapImage, NDArray | None]]:
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
    out = np.empty(len(numbers), OBSERVATION)
    out["xy"], out["point"] = numbers[:, :2], numbers[:, 2]
    return out


def read_points_txt(source: Source, notes: list[str]) -> NDArray:
    """Return the points [P] as `POINT`. Adds a note if their colours are not bytes."""
    rows = [line.split(maxsplit=8)[:8] for line in _read_lines(source) if line.strip()]
    try:
        numbers = np.array([[float(x) for x in row] for row in rows], dtype=np.float64).reshape(len(rows), 8)
        numbers[:, 7][~np.isfinite(numbers[:, 7])] = -1
        expect_range(numbers[:, 0], "numbers of points")
        rgb, said = to_bytes(numbers[:, 4:7], source.path)
    except ValueError:
        raise _bad_line_error(source.path, next((" ".join(row) for row in rows if len(row) < 8), " ".join(rows[0]))) from None
    out = np.empty(len(rows), POINT)
    out["id"], out["xyz"], out["rgb"], out["error"], out["length"] = numbers[:, 0], numbers[:, 1:4], rgb, numbers[:, 7], 0
    notes += said
    return out
