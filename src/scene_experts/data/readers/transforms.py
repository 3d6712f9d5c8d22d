"""Reads the frames of transforms*.json, which NeRF-synthetic and nerfstudio captures share.

`transform_matrix` maps the camera to the world with OpenGL axes (y up, looking along -z). Its
second and third columns are negated to obtain OpenCV axes.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np
from numpy.typing import NDArray

from scene_experts.core.errors import InputError
from scene_experts.core.io import read_json
from scene_experts.core.reading.numbers import FARTHEST, shown, to_size
from scene_experts.core.reading.source import describe, shorten
from scene_experts.core.types import Points
from scene_experts.data.images import probe
from scene_experts.data.lens import Lens
from scene_experts.data.match import EXTENSIONS, find_file, match_images
from scene_experts.data.points import find_cloud
from scene_experts.data.points import read_points as read_cloud
from scene_experts.data.readers.reader import PosedImage

_PINHOLES = ("PERSPECTIVE", "PINHOLE", "SIMPLE_PINHOLE", "")
_BESIDE_FOCAL = ("cx", "cy", "fl_y", "camera_angle_y", *(f"k{i}" for i in range(1, 7)), "p1", "p2")
_MODELS = ("OPENCV", "OPENCV_FISHEYE", "FULL_OPENCV", "SIMPLE_RADIAL", "RADIAL", *_PINHOLES)


def read_meta(path: Path) -> dict[str, Any]:
    """Read the JSON object in `path`. Raises InputError if it has no list of frames, or if the list
    is empty."""
    meta = read_json(path, "list of camera poses")
    if not isinstance(meta, dict) or not isinstance(meta.get("frames"), list) or not all(isinstance(f, dict) for f in meta["frames"]):
        raise InputError(f"expected an object with a list of frames in {path}, found something else; restore the file")
    if not meta["frames"]:
        raise InputError(f"expected at least one frame in {path}, found none; training needs camera poses")
    return meta


def read_file_path(frame: dict[str, Any], index: int, path: Path) -> str:
    """Return the `file_path` of a frame. Raises InputError if it has none."""
    value = frame.get("file_path")
    if not isinstance(value, str) or not value:
        raise InputError(f"expected a file_path in frame {index} of {path}, found {shown(value)}; restore the file")
    return value


def read_angle(meta: dict[str, Any], frame: dict[str, Any], path: Path, axis: str = "x") -> float:
    """Return the field of view along an axis, in radians, of a frame without a focal length. Raises
    InputError if it has neither."""
    angle = {**meta, **frame}.get(f"camera_angle_{axis}")
    if not isinstance(angle, (int, float)) or not 1e-6 < angle < math.pi - 1e-6:
        raise InputError(
            f"expected fl_{axis}, or camera_angle_{axis} between 0 and pi, in {path}, found {shown(angle)}; add the focal length"
        )
    return float(angle)


def to_pure(name: str) -> PurePosixPath:
    """Return the path that a name in the file stands for: "./a/b" and "a\\b" are the same as
    "a/b"."""
    return PurePosixPath(name.replace("\\", "/"))


def find_image(root: Path, file_path: str, images: str | None) -> tuple[str, Path | None]:
    """Return the name of a view and its file, or None instead of the file if it is absent.

    A path without an extension matches an image with any known extension. `images` replaces the
    first folder of the path.
    """
    parts = list(to_pure(file_path).parts)
    if images is not None:
        parts = [images, *parts[1:]] if len(parts) > 1 else [images, *parts]
    name = "/".join(parts)
    for candidate in (name, *(name + ending for lower in EXTENSIONS for ending in (lower, lower.upper()))):
        if path := find_file(root, candidate):
            return candidate, path
    return name, None


def find_images(root: Path, file_paths: Sequence[str], images: str | None, warnings: list[str]) -> list[tuple[str, Path | None]]:
    """Return the name and the file of each view, as `find_image` does, and add warnings about
    files that are not called as stated.

    What is absent is looked for in the first folder of its path, or in `images`, under other
    extensions and in other folders, as `match_images` does.
    """
    found = [find_image(root, path, images) for path in file_paths]
    usual = images or "images"
    rest: dict[str, list[tuple[int, str]]] = {}
    for index, name in ((index, name) for index, (name, path) in enumerate(found) if path is None):
        first, _, inner = name.partition("/")
        inside = inner and first and (root / first).is_dir()
        rest.setdefault(first if inside else usual, []).append((index, inner if inside else name))
    for folder, names in rest.items():
        if not (root / folder).is_dir():
            continue
        matched = match_images(root / folder, [name for _, name in names])
        warnings += matched.warnings
        for index, name in names:
            if name in matched.found:
                file = matched.found[name]
                found[index] = file.relative_to(root).as_posix(), file
    return found


def find_beside(root: Path, named: object) -> Path | None:
    """Return the file that a frame names beside its photograph (a mask, a depth map), or None."""
    return find_file(root, str(to_pure(str(named)))) if named else None


def drop_absent(root: Path, images: Sequence[PosedImage | None], names: Sequence[str], warnings: list[str]) -> list[PosedImage]:
    """Return the images that exist, and add a warning if some do not.

    Raises InputError if no image exists or a name occurs twice.
    """
    kept = [image for image in images if image is not None]
    absent = [name for name, image in zip(names, images) if image is None]
    if not kept:
        raise InputError(f"expected {len(images)} images in {root}, found none (first: {absent[0]}); copy them there")
    if absent:
        warnings.append(f"dropped {len(absent)} of {len(images)} frames because their image is absent (first: {absent[0]})")
    present = sorted(image.name for image in kept)
    twice = next((a for a, b in pairwise(present) if a == b), None)
    if twice is not None:
        raise InputError(f"expected every image once in the frames of {root}, found {twice} twice; remove one of its poses")
    return kept


def read_pose(frame: dict[str, Any], path: Path) -> NDArray[np.float64]:
    """Return the world-to-camera matrix [4, 4] of a frame, OpenCV axes.

    The rotation is replaced by the nearest exact rotation, because files hold rounded numbers.
    Raises InputError if the matrix is absent, not finite, or scales or mirrors.
    """
    where = shorten(str(frame.get("file_path")))
    try:
        pose = np.asarray(frame.get("transform_matrix"), dtype=np.float64)
    except (TypeError, ValueError):
        pose = np.empty(0)
    if pose.shape not in ((4, 4), (3, 4)) or not (np.abs(pose) <= FARTHEST).all():  # False for NaN
        raise InputError(f"expected a finite 4x4 transform_matrix for {where} in {path}, found none; remove that frame")
    u, s, v = np.linalg.svd(pose[:3, :3])
    if np.linalg.det(pose[:3, :3]) <= 0 or np.abs(s - 1).max() > 1e-2:
        raise InputError(f"expected a rotation in the transform_matrix of {where} in {path}, found a matrix that scales; restore the file")
    rotation = (u @ v) * np.array([1.0, -1.0, -1.0])  # columns: right, up -> down, back -> forward
    out = np.eye(4)
    out[:3, :3] = rotation.T
    out[:3, 3] = -rotation.T @ pose[:3, 3]
    return out


def read_lens(meta: dict[str, Any], frame: dict[str, Any], path: Path, image: Path | None) -> Lens | None:
    """Return the lens of a frame, or None if only the field of view is given. Values of the frame
    override shared ones.

    Without a focal length, the field of view gives it; `image` gives the size where w and h are
    absent. `is_fisheye` (instant-ngp) stands for a camera model. Raises InputError for an
    unsupported camera model, for values that are not numbers, and for k4 without k5 and k6 outside
    a fisheye and FULL_OPENCV: nerfstudio multiplies by its term, OpenCV divides by it.
    """
    both = {**meta, **frame}
    model = str(both.get("camera_model", "OPENCV_FISHEYE" if both.get("is_fisheye") is True else "OPENCV")).upper()
    if model not in _MODELS:
        raise InputError(f"expected camera_model OPENCV, OPENCV_FISHEYE or PINHOLE in {path}, found {shown(model)}; convert the capture")
    given = "fl_x" in both
    if not given and (image is None or not (model == "OPENCV_FISHEYE" or any(both.get(name) for name in _BESIDE_FOCAL))):
        return None
    if image is not None and not (both.get("w") and both.get("h")):
        both |= dict(zip("wh", _measure(image, both)))
    try:
        width, height = to_size(both["w"]), to_size(both["h"])
        fx = float(both["fl_x"]) if given else 0.5 * width / math.tan(0.5 * read_angle(meta, frame, path))
        fy = float(both.get("fl_y", fx))
        if not given and "fl_y" not in both and both.get("camera_angle_y") is not None:
            other = 0.5 * height / math.tan(0.5 * read_angle(meta, frame, path, "y"))
            fy = fx if math.isclose(fx, other, rel_tol=1e-3) else other  # the angles of square pixels are rounded
        cx, cy = float(both.get("cx", width / 2)), float(both.get("cy", height / 2))
        k = [float(both.get(f"k{i}", 0.0) or 0.0) for i in range(1, 7)]
        p = [float(both.get(f"p{i}", 0.0) or 0.0) for i in (1, 2)]
    except (KeyError, TypeError, ValueError, OverflowError) as error:
        raise InputError(f"expected numbers as w, h, fl_x, fl_y, cx and cy in {path}, found {describe(error)}; restore the file") from None
    if k[3] and not any(k[4:]) and model not in ("OPENCV_FISHEYE", "FULL_OPENCV"):
        raise InputError(
            f"expected no k4 beside camera_model {model} in {path}, found {k[3]:g}, which programs use in different ways; fit the lens "
            f"without k4, or write FULL_OPENCV if it is that of OpenCV"
        )
    if model in _PINHOLES and not any((*k, *p)):  # nerfstudio reads k and p whatever the model is called
        lens = Lens("PINHOLE", width, height, (fx, fy, cx, cy))
    elif model == "OPENCV_FISHEYE":
        lens = Lens(model, width, height, (fx, fy, cx, cy, *k[:4]))
    elif any(k[2:]):
        lens = Lens("FULL_OPENCV", width, height, (fx, fy, cx, cy, k[0], k[1], *p, *k[2:]))
    else:
        lens = Lens("OPENCV", width, height, (fx, fy, cx, cy, k[0], k[1], *p))
    plain = not lens.distorted and fx == fy and (cx, cy) == (width / 2, height / 2)  # the field of view says it all
    return None if plain and not given else lens


def _measure(image: Path, values: dict[str, Any]) -> tuple[int, int]:
    """Return the size of a photograph whose frame states none: as stored, or turned by its EXIF
    orientation if the principal point is nearer to that middle."""

    def away(size: tuple[int, int]) -> float:
        return sum(abs(float(values[name]) - side / 2) for name, side in zip(("cx", "cy"), size) if values.get(name) is not None)

    header = probe(image)
    return min((header.size, header.turned), key=away)  # the first of equals


def read_points(root: Path, named: object, warnings: list[str]) -> tuple[Points | None, Path | None]:
    """Return the points of the PLY file `named`, or of a file with a usual name, and that file if
    it is not named. Adds warnings about a choice of files and about colours.

    Raises InputError if the named file is absent or the file is damaged.
    """
    path = find_file(root, str(to_pure(named))) if isinstance(named, str) else find_cloud([root], warnings)
    if path is None and isinstance(named, str):
        raise InputError(f"expected the points of {root} in {shorten(named)}, found no such file; restore it or give --points FILE")
    points = None if path is None else read_cloud(path, warnings)
    return points, None if isinstance(named, str) else path
