"""Captures described by transforms*.json: NeRF-synthetic scenes and nerfstudio's format.

`transform_matrix` is camera to world with OpenGL axes (y up, z backwards); its second and third columns are negated for OpenCV's.
"""

from __future__ import annotations

import math
from itertools import pairwise
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from scene_experts.core.errors import InputError
from scene_experts.core.io import read_json
from scene_experts.core.types import Points
from scene_experts.data.lens import Lens
from scene_experts.data.match import EXTENSIONS, find_mask
from scene_experts.data.readers.found import Colour, Found, Posed
from scene_experts.data.readers.ply import read_points

_PLY_NAMES = ("points3d.ply", "sparse_pc.ply", "points3D.ply")
_PINHOLES = ("PERSPECTIVE", "PINHOLE", "SIMPLE_PINHOLE", "")


def read_blender(root: Path, background: Colour | None) -> Found:
    """transforms_train.json and, where present, transforms_test.json; alpha is composited over `background`, white where None.

    Frames whose file is absent are dropped with a warning. Raises InputError where a file cannot be used or no frame is left.
    """
    posed, warnings = [], []
    for part in ("train", "test"):
        path = root / f"transforms_{part}.json"
        if part == "train" or path.is_file():
            meta = _meta(path)
            for i, frame in enumerate(meta["frames"]):
                name, image = _image(root, _text(frame, i, path), None)
                lens = _lens(meta, frame, path) if "fl_x" in {**meta, **frame} else None
                angle = _angle(meta, frame, path) if lens is None else 0.0
                posed.append((image, Posed(name, image or root, lens, _pose(frame, path), None, angle, part == "test")))
    kept = _present(root, posed, warnings)
    if background is None:
        background = (1.0, 1.0, 1.0)
        warnings.append("transparent pixels are composited over white; give --background for another colour (Scaffold-GS scores on black)")
    return Found("blender", kept, _points(root, None), warnings, background, _PLY_NAMES[0])


def read_nerfstudio(root: Path, images: str | None) -> Found:
    """transforms.json with intrinsics for all or for each frame; models OPENCV, OPENCV_FISHEYE and pinhole.

    `images` replaces the first folder of every file path. Frames whose file is absent are dropped with a warning.
    """
    path = root / "transforms.json"
    meta = _meta(path)
    posed, warnings = [], []
    tests = meta.get("test_filenames") or []
    if not isinstance(tests, list):
        raise InputError(f"expected test_filenames as a list in {path}, found {tests!r}; restore the file")
    for i, frame in enumerate(meta["frames"]):
        name, image = _image(root, _text(frame, i, path), images)
        lens = _lens(meta, frame, path)
        given = root / str(frame["mask_path"]) if frame.get("mask_path") else None
        mask = given if given is not None and given.is_file() else find_mask(root, _inside(name), image) if image else None
        angle = _angle(meta, frame, path) if lens is None else 0.0
        posed.append((image, Posed(name, image or root, lens, _pose(frame, path), mask, angle, frame.get("file_path") in tests)))
    kept = _present(root, posed, warnings)
    return Found("nerfstudio", kept, _points(root, meta.get("ply_file_path")), warnings, None, "the file that ply_file_path names")


def _meta(path: Path) -> dict[str, Any]:
    meta = read_json(path, "list of camera poses")
    if not isinstance(meta, dict) or not isinstance(meta.get("frames"), list) or not all(isinstance(f, dict) for f in meta["frames"]):
        raise InputError(f"expected an object with a list of frames in {path}, found something else; restore the file")
    if not meta["frames"]:
        raise InputError(f"expected at least one frame in {path}, found none; no cameras means nothing to train on")
    return meta


def _text(frame: dict[str, Any], index: int, path: Path) -> str:
    value = frame.get("file_path")
    if not isinstance(value, str) or not value:
        raise InputError(f"expected a file_path in frame {index} of {path}, found {value!r}; restore the file")
    return value


def _angle(meta: dict[str, Any], frame: dict[str, Any], path: Path) -> float:
    """The horizontal angle of view of a frame without a focal length, radians."""
    angle = {**meta, **frame}.get("camera_angle_x")
    if not isinstance(angle, (int, float)) or not 0 < angle < math.pi:
        raise InputError(f"expected fl_x, or camera_angle_x between 0 and pi, in {path}, found {angle!r}; add the focal length")
    return float(angle)


def _image(root: Path, file_path: str, images: str | None) -> tuple[str, Path | None]:
    """Name of the view and its file (None where absent). A path without an extension may mean any image of that stem."""
    pure = PurePosixPath(file_path.replace("\\", "/"))
    parts = [p for p in pure.parts if p != "."]
    if images is not None:
        parts = [images, *parts[1:]] if len(parts) > 1 else [images, *parts]
    name = "/".join(parts)
    for candidate in (name, *(name + ending for ending in EXTENSIONS)):
        if (root / candidate).is_file():
            return candidate, root / candidate
    return name, None


def _inside(name: str) -> str:
    """`name` without its first folder (masks/0001.png belongs to images/0001.png)."""
    return name.partition("/")[2] or name


def _present(root: Path, posed: list[tuple[Path | None, Posed]], warnings: list[str]) -> list[Posed]:
    kept = [view for image, view in posed if image is not None]
    absent = [view.name for image, view in posed if image is None]
    if not kept:
        raise InputError(f"expected {len(posed)} images in {root}, found none of them (first: {absent[0]}); copy them there")
    if absent:
        warnings.append(f"{len(absent)} of {len(posed)} frames dropped: their image is absent (first: {absent[0]})")
    names = sorted(view.name for view in kept)
    twice = next((a for a, b in pairwise(names) if a == b), None)
    if twice is not None:
        raise InputError(f"expected every image once in the frames of {root}, found {twice} twice; remove one of its poses")
    return kept


def _pose(frame: dict[str, Any], path: Path) -> NDArray[np.float64]:
    """World to camera, OpenCV axes, [4, 4]. Rounding in the file is removed by taking the nearest rotation."""
    where = frame.get("file_path")
    try:
        pose = np.asarray(frame.get("transform_matrix"), dtype=np.float64)
    except (TypeError, ValueError):
        pose = np.empty(0)
    if pose.shape not in ((4, 4), (3, 4)) or not np.isfinite(pose).all():
        raise InputError(f"expected a finite 4x4 transform_matrix for {where} in {path}, found none; remove that frame")
    u, s, v = np.linalg.svd(pose[:3, :3])
    if np.linalg.det(pose[:3, :3]) <= 0 or np.abs(s - 1).max() > 1e-2:
        raise InputError(f"expected a rotation in the transform_matrix of {where} in {path}, found one that stretches; restore it")
    rotation = (u @ v) * np.array([1.0, -1.0, -1.0])  # columns: right, up -> down, back -> forward
    out = np.eye(4)
    out[:3, :3] = rotation.T
    out[:3, 3] = -rotation.T @ pose[:3, 3]
    return out


def _lens(meta: dict[str, Any], frame: dict[str, Any], path: Path) -> Lens | None:
    """The lens of one frame (its own values before the shared ones), or None where only an angle of view is given."""
    both = {**meta, **frame}
    model = str(both.get("camera_model", "OPENCV")).upper()
    if model not in ("OPENCV", "OPENCV_FISHEYE", "FULL_OPENCV", "SIMPLE_RADIAL", "RADIAL", *_PINHOLES):
        raise InputError(f"expected camera_model OPENCV, OPENCV_FISHEYE or PINHOLE in {path}, found {model!r}; convert the capture")
    if "fl_x" not in both:
        return None
    try:
        width, height, fx = int(both["w"]), int(both["h"]), float(both["fl_x"])
        fy = float(both.get("fl_y", fx))
        cx, cy = float(both.get("cx", width / 2)), float(both.get("cy", height / 2))
        k = [float(both.get(f"k{i}", 0.0) or 0.0) for i in range(1, 7)]
        p = [float(both.get(f"p{i}", 0.0) or 0.0) for i in (1, 2)]
    except (KeyError, TypeError, ValueError, OverflowError) as error:
        raise InputError(f"expected numbers for w, h, fl_x, fl_y, cx and cy in {path}, found {error}; restore the file") from None
    if model in _PINHOLES:
        return Lens("PINHOLE", width, height, (fx, fy, cx, cy))
    if model == "OPENCV_FISHEYE":
        return Lens(model, width, height, (fx, fy, cx, cy, *k[:4]))
    if any(k[2:]):
        return Lens("FULL_OPENCV", width, height, (fx, fy, cx, cy, k[0], k[1], *p, *k[2:]))
    return Lens("OPENCV", width, height, (fx, fy, cx, cy, k[0], k[1], *p))


def _points(root: Path, named: object) -> Points | None:
    if isinstance(named, str) and not (root / named).is_file():
        raise InputError(f"expected the points of {root} in {named}, found no such file; restore it or start with --init random")
    for name in (named,) if isinstance(named, str) else _PLY_NAMES:
        if (root / name).is_file():
            xyz, rgb = read_points(root / name)
            return Points(torch.from_numpy(xyz), torch.from_numpy(rgb)) if len(xyz) else None
    return None
