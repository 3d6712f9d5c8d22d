"""Loads a capture: recognises its kind, matches images, undistorts, resizes, splits and normalises. `load` is the one way in."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Literal

import numpy as np
import torch

from scene_experts.core.errors import InputError
from scene_experts.core.types import Camera, Points
from scene_experts.data import prepare
from scene_experts.data.images import Source, check_policy, probe
from scene_experts.data.lens import Lens, pinhole_of, without_principal_point
from scene_experts.data.match import EXTENSIONS, absent_error, find_mask, match_images, plain_name
from scene_experts.data.readers import colmap, transforms
from scene_experts.data.readers.found import Colour, Found, Posed
from scene_experts.data.store import ImageStore
from scene_experts.data.views import Capture, Frame, View, World

__all__ = ["Capture", "Frame", "View", "World", "load"]


def load(
    path: Path | str,
    *,
    images: str | None = None,
    resolution: str = "auto",
    split: str = "auto",
    normalise: Literal["extent", "none"] = "extent",
    init: Literal["points", "random"] = "points",
    max_views: int | None = None,
    ignore_principal_point: bool = False,
    background: Colour | None = None,
    cache_bytes: int | None = None,
    missing: Literal["error", "drop"] = "error",
    seed: int = 0,
    look: bool = False,
) -> Capture:
    """Load the capture in folder `path`: COLMAP (sparse/0, images), NeRF-synthetic (transforms_train.json), nerfstudio (transforms.json).

    images: folder of the photographs, relative to `path`, e.g. "images_4"; intrinsics follow the size found there.
    resolution: "auto" (= "cap1600"), "as-is", "cap1600", "factor:N", "longest:N", "share:S", or "inria:N" (the folder images_N as it is).
    split: "auto" (files for NeRF-synthetic and where transforms.json names test views, else mod8), "modN", "first:N", "none", "files".
    normalise: "extent" trains in a world centred on the mean training camera with extent 5; "none" in the capture's own.
    init: "points" needs 3D points; "random" replaces them by random ones.
    ignore_principal_point: believe that it is at the image centre (parity with the original code only).
    background: RGB in [0, 1] behind the scene; None is black, and white for NeRF-synthetic.
    cache_bytes: room for decoded frames; None is a third of the free memory.  missing: what to do about absent images of a COLMAP capture.
    seed: of the random points.
    look: admit a capture without points, with a warning; only to be looked at, as nothing can start from it.

    Raises InputError for anything that cannot be used, in one sentence that says what to change.
    """
    root = Path(path)
    policy = check_policy(resolution)
    found = _read(root, _folder(root, images, policy), background, missing)
    capture = _assemble(root, found, ignore_principal_point, background or found.over or (0.0, 0.0, 0.0), cache_bytes)
    if max_views is not None:
        capture = prepare.at_most(capture, max_views)
    capture = prepare.drop_outlier_views(capture)
    auto = "files" if found.kind == "blender" or capture.test else "mod8"
    capture = prepare.measured(prepare.hold_out(capture, auto if split == "auto" else split))
    if normalise == "extent":
        capture = prepare.normalised(capture)
    capture = _with_points(prepare.drop_outliers(capture), found, init, seed, look)
    return _finish(prepare.downscale(capture, policy))


def _folder(root: Path, images: str | None, policy: str) -> str | None:
    """The image folder to read: what was asked for, images_N for "inria:N", else None (the capture's own)."""
    if not root.is_dir():
        raise InputError(f"expected the folder of a capture at {root}, found {'a file' if root.is_file() else 'nothing'}; check the path")
    if images is None and policy.startswith("inria:"):
        images = f"images_{policy.partition(':')[2]}"
    if images is not None and not (root / images).is_dir():
        have = sorted(p.name for p in root.iterdir() if p.is_dir() and p.name.startswith("images"))
        raise InputError(
            f"expected the image folder {images} in {root}, found {', '.join(have) or 'none'}; name one of those with --images or "
            f"resize on the fly with --resolution factor:N"
        )
    return images


def _read(root: Path, images: str | None, background: Colour | None, missing: str) -> Found:
    if colmap.find_model(root) is not None:
        return _read_colmap(root, images or "images", missing)
    if (root / "transforms_train.json").is_file():
        return transforms.read_blender(root, background)
    if (root / "transforms.json").is_file():
        return transforms.read_nerfstudio(root, images)
    raise no_capture(root)


def is_capture(root: Path) -> bool:
    """Whether a folder holds poses of a kind that `load` reads."""
    return colmap.find_model(root) is not None or any((root / f"transforms{end}.json").is_file() for end in ("", "_train"))


def no_capture(root: Path) -> InputError:
    """Why a folder is no capture, and what to do: photographs alone need poses first."""
    expected = f"expected a capture in {root} (COLMAP's sparse/0 beside images, transforms_train.json or transforms.json), found"
    if is_capture(root.absolute().parent):
        return InputError(f"{expected} a part of one; give the folder that holds it: {root.absolute().parent}")
    for folder in (root, root / "images"):
        photos = sum(p.suffix.lower() in EXTENSIONS for p in folder.iterdir()) if folder.is_dir() else 0
        if photos:
            out = "CAPTURE" if folder == root else str(root)
            return InputError(f"{expected} {photos} photographs without camera poses; run `scene-experts capture {folder} --out {out}`")
    if (root / ".capture").is_dir():
        return InputError(f"{expected} one that is not whole; give its `scene-experts capture PHOTOS --out {root}` again")
    return InputError(f"{expected} none of them; point to the folder that holds them")


def _read_colmap(root: Path, images: str, missing: str) -> Found:
    folder = colmap.find_model(root)
    assert folder is not None
    model = colmap.read_model(folder)
    names = sorted(image.name for image in model.images)
    twice = next((a for a, b in pairwise(names) if a == b), None)
    if twice is not None:
        raise InputError(f"expected every image once in {folder}, found {twice} twice; remove one of its poses")
    above = next((p for p in (root.absolute().parent, root.absolute().parent.parent) if (p / images).is_dir()), None)
    if not (root / images).is_dir() and above is not None and folder.samefile(root):
        raise InputError(
            f"expected the folder of a capture at {root}, found its reconstruction alone; give the folder that holds it: {above}"
        )
    match = match_images(root / images, names)
    warnings = list(match.warnings)
    if match.absent and (missing == "error" or not match.found):
        raise absent_error(root / images, names, match.absent)
    if match.absent:
        warnings.append(f"{len(match.absent)} of {len(names)} views dropped: their image is absent (first: {match.absent[0]})")
    others = [p for p in folder.parent.iterdir() if folder.name == "0" and p.is_dir() and p.name.isdigit() and p.name != "0"]
    if others:
        warnings.append(f"{len(others) + 1} reconstructions in {folder.parent.name}/; 0 is used, the others are parts it could not join")
    posed = []
    for image in sorted(model.images, key=lambda i: i.name):
        if image.name in match.found:
            path = match.found[image.name]
            mask = find_mask(root, image.name, path)
            posed.append(Posed(image.name, path, model.cameras[image.camera_id], image.world_to_cam(), mask))
    points = Points(torch.from_numpy(model.xyz), torch.from_numpy(model.rgb)) if len(model.xyz) else None
    return Found("colmap", posed, points, warnings)


def _assemble(root: Path, found: Found, centred: bool, background: Colour, cache_bytes: int | None) -> Capture:
    """The capture in its own world at the files' resolution, in float64, before any choice but the kind."""
    views, sources = [], []
    posed = sorted((replace(view, name=plain_name(view.name)) for view in found.posed), key=lambda v: v.name)
    twice = next((b for a, b in pairwise(posed) if a.name == b.name), None)
    if twice is not None:
        raise InputError(f"expected images in {root} that differ in their names, found two called {twice.name}; rename one of them")
    for i, view in enumerate(posed):
        lens, turn = _fitted(view)
        if centred:
            lens = without_principal_point(lens)
        flat = pinhole_of(lens)
        K = torch.tensor([[flat.fx, 0, flat.cx], [0, flat.fy, flat.cy], [0, 0, 1]], dtype=torch.float64)
        camera = Camera(torch.from_numpy(view.world_to_cam), K, flat.width, flat.height, id=i)
        views.append(View(view.name, camera, view.path))
        sources.append(Source(view.path, lens, (flat.width, flat.height), view.mask, turn, found.over))
    train, test = (tuple(i for i, v in enumerate(posed) if v.test == held) for held in (False, True))
    store = ImageStore(sources, cache_bytes)
    name = root.resolve().name
    return Capture(
        name,
        root,
        found.kind,
        tuple(views),
        found.points,
        train,
        test,
        store,
        World(),
        1.0,
        "as-is",
        "none",
        background,
        tuple(found.warnings),
    )


def _fitted(view: Posed) -> tuple[Lens, bool]:
    """The lens of `view` at the size of its file, and whether the file must be turned by its EXIF orientation to fit."""
    stored, turned = probe(view.path)
    if view.lens is None:
        w, h = stored
        f = 0.5 * w / np.tan(0.5 * view.angle)
        return Lens("SIMPLE_PINHOLE", w, h, (f, w / 2, h / 2)), False
    for size in dict.fromkeys((stored, turned)):
        (w, h), lens = size, view.lens
        # a downscaled copy has sides cut or rounded to whole pixels, so its ratios may differ by a pixel
        if abs(w * lens.height - h * lens.width) <= max(lens.width, lens.height, 0.01 * w * lens.height):
            return lens.resized(w, h), size != stored
    raise InputError(
        f"expected {view.path} in the shape of its camera ({view.lens.width}x{view.lens.height}), found {stored[0]}x{stored[1]}; "
        f"use the photographs that the cameras were reconstructed from"
    )


def _with_points(capture: Capture, found: Found, init: str, seed: int, look: bool) -> Capture:
    if init == "random":
        return prepare.random_points(capture, seed=seed)
    if capture.points is None and found.kind == "blender":  # such captures have none; 3DGS starts them from random ones
        note = f"no 3D points: {prepare.RANDOM_POINTS:,} random ones to start from"
        return prepare.random_points(replace(capture, warnings=(*capture.warnings, note)), seed=seed)
    if capture.points is None and look:
        return replace(capture, warnings=(*capture.warnings, "no 3D points to start from: train with --init random"))
    if capture.points is None:
        raise InputError(
            f"expected 3D points in {found.points_from} of {capture.root}, found none; start from random ones with --init random"
        )
    return capture


def _finish(capture: Capture) -> Capture:
    """Cameras in float32, and the remarks on the whole."""
    views = tuple(replace(v, camera=v.camera.to(dtype=torch.float32)) for v in capture.views)
    notes = list(capture.warnings)
    if 0 < len(capture.test) < 5:
        notes.append(f"only {len(capture.test)} test views: scores on so few say little")
    sizes = {(v.camera.width, v.camera.height) for v in views}
    if len(sizes) > 1:
        notes.append(f"views of {len(sizes)} sizes")
    if capture.points is not None and len(capture.points.xyz) < 500:
        notes.append(f"only {len(capture.points.xyz)} points to start from")
    return replace(capture, views=views, warnings=tuple(notes))
