"""What the readers of files of poses share: finding the file, its photographs and its points."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path, PurePosixPath

import numpy as np
from numpy.typing import NDArray

from scene_experts.core.errors import InputError
from scene_experts.core.reading.budget import HEAD
from scene_experts.core.reading.numbers import FARTHEST
from scene_experts.core.reading.plain import decode_text
from scene_experts.core.reading.source import opening, shorten
from scene_experts.core.types import Points
from scene_experts.data.depth_maps import DepthFile
from scene_experts.data.images import Size, probe
from scene_experts.data.lens import Lens
from scene_experts.data.match import EXTENSIONS, absent_error, match_images, to_relative_name
from scene_experts.data.points import find_cloud, read_points
from scene_experts.data.readers.reader import PosedImage, RawCapture, ReadOptions

_HEAD = 4096  # bytes by which a file is recognised


def find_files(folder: Path, pattern: str, fits: Callable[[str], bool]) -> list[Path]:
    """Return the files of `folder` whose name matches `pattern` and whose first bytes fit, the
    largest first. Never raises for unreadable ones."""
    found = []
    for path in sorted(folder.glob(pattern)) if folder.is_dir() else ():
        try:
            with opening(path, HEAD) as source:
                if fits(decode_text(source.head(_HEAD))):
                    found.append((-source.size, path))
        except InputError:
            continue
    return [path for _, path in sorted(found)]


def choose_file(folder: Path, found: Sequence[Path], options: ReadOptions, warnings: list[str]) -> Path:
    """Return `options.model`, or the largest of the files. Adds a warning if there are several."""
    if options.model is not None:
        return options.model
    if len(found) > 1:
        others = ", ".join(path.name for path in found[1:])
        warnings.append(f"{found[0].name} is read, the largest of the files of poses; choose another with --model ({others})")
    return found[0]


@dataclass(frozen=True)
class Pose:
    """A photograph as a file of poses names it: its name or label, and its camera [4, 4], world to
    camera with OpenCV axes. `lens` gives the lens for the size in px that the photograph had when
    it was aligned."""

    name: str
    world_to_cam: NDArray[np.float64]
    lens: Callable[[Size], Lens] = field(repr=False)


def assemble(
    folder: Path,
    path: Path,
    poses: Sequence[Pose],
    options: ReadOptions,
    warnings: list[str],
    *,
    images: Path | None = None,
    points: Points | None = None,
    own_points: bool = False,
    depths: Mapping[str, DepthFile] | None = None,
) -> RawCapture:
    """Return the capture of the poses in `path`: their photographs, masks and points.

    Args:
        images: Folder of the photographs. None: `options.images`, else "images", else `folder`.
        points: The points that the file holds.
        own_points: Whether the format holds points. Otherwise a PLY file beside the poses does.
        depths: Depth maps, by the names of their poses.

    Raises InputError if photographs are absent (with `options.missing == "drop"`: if all are), and
    if two poses are of one.
    """
    if not poses:
        raise InputError(f"expected at least one pose in {path}, found none; align the photographs and export them again")
    names = [_with_extension(to_relative_name(pose.name).removeprefix("images/")) for pose in poses]
    twice = next((a for a, b in pairwise(sorted(names)) if a == b), None)
    if twice is not None:
        raise InputError(f"expected every photograph once in {path}, found {shorten(twice)} twice; remove one of its poses")
    usual = folder / "images"
    places = [images or folder / (options.images or "")] if images or options.images else [p for p in (usual, folder) if p.is_dir()]
    matches = [match_images(place, names) for place in places]
    best = max(range(len(places)), key=lambda i: (len(matches[i].found), -len(matches[i].warnings)))
    place, match = places[best], matches[best]
    warnings += [note for note in match.warnings if any(PurePosixPath(p.name).suffix.lower() in EXTENSIONS for p in poses)]
    if match.absent and (options.missing == "error" or not match.found):
        raise absent_error(place, names, match.absent)
    if match.absent:
        warnings.append(f"dropped {len(match.absent)} of {len(names)} views because their image is absent (first: {match.absent[0]})")
    posed = []
    for name, pose in zip(names, poses):
        if name in match.found:
            file = match.found[name]
            shown = file.relative_to(usual if file.is_relative_to(usual) else place).as_posix()
            header = probe(usual / shown if (usual / shown).is_file() else file)
            try:
                lens, turned = pose.lens(header.size), pose.lens(header.turned)
            except InputError as error:
                raise InputError(f"{shorten(pose.name)} in {path}: {error}") from None
            depth = None if depths is None else depths.get(pose.name)
            posed.append(PosedImage(shown, file, lens, pose.world_to_cam, depth=depth, turned=None if turned == lens else turned))
    cloud = None
    if options.points and not own_points:
        cloud = find_cloud(list(dict.fromkeys((path.parent, folder))), warnings) or _only_cloud(folder)
        if cloud is not None:
            points = read_points(cloud, warnings)
            warnings.append(f"the points are those of {cloud.name}; choose others with --points")
        elif not depths:
            warnings.append(f"{path.name} holds no points: put a PLY file beside it, or give one with --points")
    return RawCapture(posed, points, warnings, points_source=path.name, cloud=cloud, random_points=not own_points)


def _with_extension(name: str) -> str:
    """Return the name of a file for a label, whose extension may have been left out."""
    return name if PurePosixPath(name).suffix.lower() in EXTENSIONS else f"{name}.jpg"


def _only_cloud(folder: Path) -> Path | None:
    found = sorted(folder.glob("*.ply"))
    return found[0] if len(found) == 1 else None


def to_world_to_cam(rotation: NDArray[np.float64], centre: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the matrix [4, 4] of a camera with the axes `rotation` [3, 3] (columns: right, down,
    forward in the world) at `centre` [3]."""
    out = np.eye(4)
    out[:3, :3] = rotation.T
    out[:3, 3] = -rotation.T @ centre
    return out


def nearest_rotation(matrix: NDArray[np.float64], name: str, path: Path) -> NDArray[np.float64]:
    """Return the rotation nearest to a matrix [3, 3] of rounded numbers. Raises InputError if it
    scales or mirrors by more than 1 %."""
    u, s, v = np.linalg.svd(matrix) if np.isfinite(matrix).all() else (np.eye(3), np.zeros(3), np.eye(3))
    if np.abs(s - 1).max() > 1e-2 or np.linalg.det(matrix) <= 0:
        raise InputError(
            f"expected a rotation for {shorten(name)} in {path}, found a matrix that scales or mirrors; export the poses again"
        )
    return u @ v


def to_numbers(words: Iterable[str], count: int, what: str, path: Path) -> list[float]:
    """Return `count` finite numbers. Raises InputError if there are others."""
    given = list(words)
    try:
        numbers = [float(word) for word in given]
    except ValueError:
        numbers = []
    if len(numbers) != count or not all(abs(n) <= FARTHEST for n in numbers):  # False for NaN
        raise InputError(f"expected {count} numbers as {shorten(what)} in {path}, found {shorten(' '.join(given), 60)!r}; export it again")
    return numbers
