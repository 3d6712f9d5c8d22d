"""Reads reconstructions of Bundler (v0.3 and v0.4): bundle.out and the list of its photographs.

A camera has a focal length f in pixels, two radial coefficients, and a rotation and translation
that map the world to axes x right, y up, z back. The origin of its pixels is the middle of the
picture. Many programs write this format.
"""

from __future__ import annotations

import re
from collections import deque
from collections.abc import Callable, Iterator
from itertools import islice
from pathlib import Path

import numpy as np

from scene_experts.core.errors import InputError
from scene_experts.core.reading.budget import CAPTURE, LIST, POSES, Damaged
from scene_experts.core.reading.numbers import usable_rows
from scene_experts.core.reading.plain import decode_text
from scene_experts.core.reading.source import Source, guarding, opening
from scene_experts.core.types import Points
from scene_experts.data.images import Size
from scene_experts.data.lens import Lens
from scene_experts.data.points import from_arrays
from scene_experts.data.readers import poses
from scene_experts.data.readers.colours import to_bytes
from scene_experts.data.readers.reader import RawCapture, ReadOptions

_MAGIC = "# Bundle file"
_FOCAL = re.compile(r"\s+-?\d+\s+[-+.\deE]+$")  # after a name in the list: a flag and a focal length
_OPENGL = np.diag([1.0, -1.0, -1.0])


class BundlerReader:
    """Reads bundle.out, its list of photographs and its points."""

    name = "bundler"
    files = "bundle.out and list.txt (Bundler)"

    def recognise(self, folder: Path) -> bool:
        return bool(_find(folder))

    def read(self, folder: Path, options: ReadOptions) -> RawCapture:
        """Read poses, lenses and points. Photographs without a pose are left out, with a warning.

        Raises InputError if a file is damaged, the list is absent or of another length, or
        photographs are absent (with `options.missing == "drop"`: if all are).
        """
        with guarding(folder, CAPTURE):
            warnings: list[str] = []
            path = poses.choose_file(folder, _find(folder), options, warnings)
            with opening(path, POSES) as source:
                cameras, points = _read(source, warnings, options.points)
            names = _read_list(folder, path, len(cameras))
            posed = [poses.Pose(name, *camera) for name, camera in zip(names, cameras) if camera is not None]
            if len(posed) < len(names):
                warnings.append(f"{len(names) - len(posed)} of {len(names)} photographs have no pose in {path.name}")
            if options.images is not None and not (folder / "images").is_dir():
                warnings.append(
                    f"focal lengths in {path.name} are in pixels of the aligned photographs: those in {options.images} must be of that size"
                )
            return poses.assemble(folder, path, posed, options, warnings, points=points, own_points=True)


def _find(folder: Path) -> list[Path]:
    return [
        path for place in (folder, folder / "bundle") for path in poses.find_files(place, "*.out", lambda head: head.startswith(_MAGIC))
    ]


def _words(source: Source) -> Iterator[str]:
    for line in decode_text(source.read()).splitlines():
        if not line.startswith("#"):
            source.spend_items(1)
            yield from line.split()


def _read(source: Source, warnings: list[str], want_points: bool) -> tuple[list[tuple | None], Points | None]:
    """Return the pose and lens of each camera, or None for one without, and the points."""
    words = _words(source)

    def take(count: int) -> list[float]:
        return poses.to_numbers([next(words, "") for _ in range(count)], count, "cameras and points", source.path)

    counts = take(2)
    if any(n % 1 or n < 0 for n in counts) or sum(counts) * 6 > source.size:
        raise Damaged("numbers of cameras and points that do not fit the size of the file")
    cameras: list[tuple | None] = []
    for index in range(int(counts[0])):
        f, k1, k2, *rest = take(15)
        pose = None
        if f > 0:
            pose = np.eye(4)
            pose[:3, :3] = _OPENGL @ poses.nearest_rotation(np.array(rest[:9]).reshape(3, 3), f"camera {index}", source.path)
            pose[:3, 3] = _OPENGL @ rest[9:]
        cameras.append(None if pose is None else (pose, _lens(f, k1, k2)))
    if not want_points:
        return cameras, None
    rows = np.empty((int(counts[1]), 6))
    for row in rows:
        row[:] = take(6)
        (views,) = take(1)
        if views % 1 or not 0 <= 8 * views <= source.size:
            raise Damaged(f"a point with {views:g} views")
        deque(islice(words, 4 * int(views)), maxlen=0)  # skips them
    rows = rows[usable_rows(rows[:, :3], source.path)]
    rgb, notes = to_bytes(np.clip(rows[:, 3:], 0, 255), source.path)
    warnings += notes
    return cameras, from_arrays(np.ascontiguousarray(rows[:, :3]), rgb)


def _lens(f: float, k1: float, k2: float) -> Callable[[Size], Lens]:
    def lens(size: Size) -> Lens:
        width, height = size
        return Lens("RADIAL", width, height, (f, width / 2, height / 2, k1, k2))

    return lens


def _read_list(folder: Path, path: Path, count: int) -> list[str]:
    """Return the names of the photographs, in the order of the cameras."""
    rd = path.name.endswith(".rd.out")
    names = [f"{path.name}.list.txt", f"{path.stem}.list.txt", f"{path.stem}.txt", "list.rd.txt" if rd else "list.txt", "list.txt"]
    found = next((place / name for name in names for place in (path.parent, folder) if (place / name).is_file()), None)
    if found is None:
        raise InputError(f"expected list.txt, which names the photographs of {path.name}, in {folder}, found no such file; copy it there")
    with opening(found, LIST) as source:
        lines = [line.strip() for line in decode_text(source.read()).splitlines()]
        listed = [_FOCAL.sub("", line) for line in lines if line and not line.startswith("#")]
    if len(listed) != count:
        raise InputError(
            f"expected {count} names in {found}, one for each camera of {path.name}, found {len(listed)}; use the list of this file"
        )
    return listed


READER = BundlerReader()
