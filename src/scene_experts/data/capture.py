"""Loads a capture: reads it, fits lenses to the photographs, splits, normalises and resizes. `load`
is the only entry point."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import torch

from scene_experts.core.errors import InputError, few, nearest
from scene_experts.core.fields import check_fields
from scene_experts.core.reading.budget import CAPTURE
from scene_experts.core.reading.numbers import FARTHEST, expect_range, number
from scene_experts.core.reading.source import guarding, sentence
from scene_experts.core.types import Camera
from scene_experts.data import prepare
from scene_experts.data.blocks import read_view_names
from scene_experts.data.colour import find_white
from scene_experts.data.copies import tell_copies
from scene_experts.data.depth_check import check_depths
from scene_experts.data.depth_maps import DepthPhoto, find_points
from scene_experts.data.equirectangular import find_place
from scene_experts.data.images import FrameSource, check_policy, probe
from scene_experts.data.lens import centre_principal_point, to_pinhole
from scene_experts.data.masks import find_masks
from scene_experts.data.match import NameIndex, to_relative_name
from scene_experts.data.orientation import fit_lenses
from scene_experts.data.points import check_frame, read_points
from scene_experts.data.readers import RawCapture, ReadOptions, choose_reader, tell_others, unrecognised_error
from scene_experts.data.settings import Data
from scene_experts.data.split_lists import apply_lists
from scene_experts.data.store import ImageStore
from scene_experts.data.views import FINEST, Capture, Frame, Vector, View, World

__all__ = ["Capture", "Frame", "View", "World", "load"]


def load(data: Data, seed: int = 0, *, allow_no_points: bool = False, cache_bytes: int | None = None) -> Capture:
    """Load the capture that `data` describes.

    The kind is recognised by its files: COLMAP (sparse/0 and images), NeRF-synthetic
    (transforms_train.json), nerfstudio (transforms.json), files of poses of other programs, or a
    kind whose reader was registered (see `data.readers`).

    Args:
        seed: Seed of random points.
        allow_no_points: Load a capture without 3D points, with a warning. Training cannot start
            from it.
        cache_bytes: Memory for decoded frames. None is a third of the free memory.

    Raises:
        InputError: if the capture or a setting cannot be used. The message says what to change.
    """
    check_fields(data)
    root, policy = data.path, check_policy(data.resolution)
    with guarding(root, CAPTURE):  # a reader of another package may raise anything
        raw, capture = _read(data, policy, cache_bytes)
        if raw.cloud is not None and raw.points is not None:
            notes = check_frame(raw.points, [view.camera for view in capture.views], raw.cloud)
            capture = replace(capture, warnings=(*capture.warnings, *notes))
        if data.max_views is not None:
            capture = prepare.limit_views(capture, data.max_views)
        capture = prepare.drop_outlier_views(capture)
        capture = prepare.hold_out(capture, choose_split(capture) if data.split == "auto" else data.split)
        if data.split == "auto" and capture.split == "none":
            note = f"all of {len(capture.views)} photographs are trained on; with so few, scores need --split fold:1/5 to fold:5/5, or mod8"
            capture = replace(capture, warnings=(*capture.warnings, note))
        by_depth = capture.points is None and data.init != "random" and any(view.depth for view in capture.views)
        if by_depth:
            capture = _points_of_depths(capture)
        if data.normalise == "extent":
            capture = prepare.normalise(replace(capture, extent=prepare.camera_extent(capture)))
        else:
            capture = prepare.measure_extent(capture)
        capture = prepare.drop_outliers(capture)
        replaceable = data.init in ("auto", "points") and (capture.bounds is not None or raw.random_points)
        if data.init == "random" or (capture.points is None and replaceable):
            capture = _add_random_points(capture, seed, warn=data.init != "random")
        elif capture.points is None:
            capture = _check_no_points(capture, "the depth maps" if by_depth else raw.points_source, allow_no_points)
        capture = prepare.downscale(capture, policy)
        capture = _finish(capture if by_depth else check_depths(capture))
    if data.views is not None:
        capture = choose_views(capture, data.views)
    if data.near is None:
        return capture
    return replace(capture, views=tuple(replace(v, camera=replace(v.camera, near=data.near)) for v in capture.views))


def choose_split(capture: Capture) -> str:
    """Return the split that "auto" stands for."""
    return "files" if capture.states_split or capture.test else "none" if len(capture.views) < prepare.FEW else "mod8"


def choose_views(capture: Capture, path: Path) -> Capture:
    """Return the capture with only those training views that the JSON list at `path` names. Raises
    InputError for unknown names."""
    names = set(read_view_names(path))
    chosen = tuple(index for index in capture.train if capture.views[index].name in names)
    if len(chosen) < len(names):
        unknown = sorted(names - {capture.views[index].name for index in chosen})
        capture.images.close()
        raise InputError(f"expected training views of {capture.root} in {path}, found {few(unknown)}; correct --views")
    return replace(capture, train=chosen, left_out=tuple(index for index in capture.train if index not in chosen))


def _read(data: Data, policy: str, cache_bytes: int | None) -> tuple[RawCapture, Capture]:
    """Read a capture in its own frame, at the resolution of its files."""
    root, background = data.path, data.background
    images = _find_image_folder(root, data.images, policy)
    model = None if data.model is None else root / data.model
    if data.points is not None and data.init == "random":
        raise InputError("expected --points or --init random, found both; leave one of them out")
    reader = choose_reader(root, model)
    if reader is None:
        raise unrecognised_error(root)
    raw = reader.read(root, ReadOptions(images, background, data.missing, model, points=data.points is None))
    warnings = [*raw.warnings, *([] if model else tell_others(root, reader))]
    if data.points is not None:
        cloud = data.points if not (root / data.points).is_file() else root / data.points
        raw = replace(raw, points=read_points(cloud, warnings), points_source=str(cloud), cloud=cloud)
    raw = replace(raw, warnings=warnings)
    if data.split in ("auto", "files"):
        raw = apply_lists(root, raw)
    raw, omitted = _leave_out(root, raw, data.leave_out)
    capture = _assemble(root, reader.name, raw, data.ignore_principal_point, background, cache_bytes)
    return raw, replace(capture, omitted=omitted)


def _points_of_depths(capture: Capture) -> Capture:
    """Return the capture with the points of the depth maps of its training views."""
    views = [(i, depth) for i in capture.train if (depth := capture.views[i].depth) is not None]
    pairs = [DepthPhoto(capture.images.sources[i], capture.views[i].camera.world_to_cam.double().numpy(), depth) for i, depth in views]
    points = find_points(pairs)
    if points is None:
        return capture
    of = "that of one depth map" if len(views) == 1 else f"those of {len(views)} depth maps"
    note = f"the {len(points.xyz):,} points are {of}; choose others with --points, or --init random"
    return replace(capture, points=points, warnings=(*capture.warnings, note))


def _leave_out(root: Path, raw: RawCapture, written: tuple[str, ...]) -> tuple[RawCapture, tuple[str, ...]]:
    """Return the capture without the photographs that are `written` after --leave-out, and their
    full names. Raises InputError for an unknown or ambiguous name, and if no photograph is left."""
    if not written:
        return raw, ()
    names = [to_relative_name(image.name) for image in raw.images]
    index, omitted = NameIndex(names), set()
    for word in written:
        found = sorted(index.find(word))
        if not found:
            hint = nearest(word, dict.fromkeys(key for name in sorted(names) for key in (name, Path(name).name, Path(name).stem)))
            hint = hint or f"; they are {few(sorted(names))}"
            raise InputError(f"expected names of photographs of {root} after --leave-out, found {word!r}{hint}")
        if len(found) > 1 and not _of_one_panorama(found):
            raise InputError(f"expected one photograph for --leave-out {word}, found {len(found)} ({few(found)}); write its folder too")
        omitted.update(found)
    kept = [image for image, name in zip(raw.images, names) if name not in omitted]
    if not kept:
        raise InputError(f"expected photographs of {root} beside those of --leave-out, found none; leave out fewer")
    return replace(raw, images=kept), tuple(sorted(omitted))


def _of_one_panorama(names: list[str]) -> bool:
    """Whether photographs are views of one panorama, which are left out together."""
    return len({find_place(name) for name in names}) == 1 and all(find_place(name) != name for name in names)


def _find_image_folder(root: Path, images: str | None, policy: str) -> str | None:
    """Return the folder that was asked for, images_N for "inria:N", or None for the capture's own.
    Raises InputError if it is absent."""
    if not root.is_dir():
        beside = [p.name for p in root.absolute().parent.iterdir() if p.is_dir()] if root.absolute().parent.is_dir() else []
        found = "a file" if root.is_file() else "nothing"
        raise InputError(f"expected the folder of a capture at {root}, found {found}{nearest(root.name, beside) or '; check the path'}")
    if images is None and policy.startswith("inria:"):
        images = f"images_{policy.partition(':')[2]}"
    if images is not None and not (root / images).is_dir():
        have = sorted(p.name for p in root.iterdir() if p.is_dir() and p.name.startswith("images"))
        raise InputError(
            f"expected the image folder {images} in {root}, found {', '.join(have) or 'none'}; name an existing folder with --images "
            f"or resize while loading with --resolution factor:N"
        )
    return images


def _assemble(root: Path, kind: str, raw: RawCapture, centred: bool, background: Vector | None, cache_bytes: int | None) -> Capture:
    """Build the capture in its own frame, in float64 and at the resolution of the files."""
    views, sources = [], []
    posed = sorted((replace(image, name=to_relative_name(image.name)) for image in raw.images), key=lambda image: image.name)
    twice = next((b for a, b in pairwise(posed) if a.name == b.name), None)
    if twice is not None:
        raise InputError(f"expected images with different names in {root}, found two called {twice.name}; rename one of them")
    headers = [probe(image.path) for image in posed]
    lenses, notes = fit_lenses(posed, headers, raw.points)
    white, dark = find_white([(image.path, header.mode) for image, header in zip(posed, headers)])
    inside = (image.path.relative_to(root).parts[0] for image in posed if image.path.is_relative_to(root))
    folders = [root, *(root / name for name in sorted(set(inside)))]
    stated = {image.name: image.mask for image in posed if image.mask is not None}
    masks = find_masks({image.name: image.path for image in posed}, folders, stated=stated)
    for i, (image, (lens, turn)) in enumerate(zip(posed, lenses)):
        if centred:
            lens = centre_principal_point(lens)
        flat = to_pinhole(lens)
        K = torch.tensor([[flat.fx, 0, flat.cx], [0, flat.fy, flat.cy], [0, 0, 1]], dtype=torch.float64)
        camera = Camera(torch.from_numpy(image.world_to_cam), K, flat.width, flat.height, id=i)
        views.append(View(image.name, camera, image.path, image.depth))
        sources.append(FrameSource(image.path, lens, (flat.width, flat.height), masks.masks.get(image.name), turn, raw.alpha_over, white))
    train, test = (tuple(i for i, image in enumerate(posed) if image.test == held) for held in (False, True))
    return Capture(
        name=name_capture(root),
        root=root,
        kind=kind,
        views=tuple(views),
        points=raw.points,
        train=train,
        test=test,
        images=ImageStore(sources, cache_bytes),
        world=World(),
        extent=1.0,
        resolution="as-is",
        split="none",
        background=background or raw.alpha_over or (0.0, 0.0, 0.0),
        warnings=(*raw.warnings, *notes, *dark, *masks.warnings),
        states_split=raw.states_split,
        bounds=raw.bounds,
        applied=raw.applied,
        applied_scale=raw.applied_scale,
        model=raw.model,
    )


def name_capture(root: Path) -> str:
    """Return what a capture is called: its folder, or the folder above one that `make` called
    "capture"."""
    here = root.resolve()
    return here.parent.name if here.name == "capture" and here.parent.name else here.name


def _add_random_points(capture: Capture, seed: int, warn: bool) -> Capture:
    if warn:
        note = f"no 3D points: training starts from {prepare.RANDOM_POINTS:,} random points"
        capture = replace(capture, warnings=(*capture.warnings, note))
    return replace(prepare.add_random_points(capture, seed=seed), random_points=True)


def _check_no_points(capture: Capture, source: str, allow: bool) -> Capture:
    """Add a warning to a capture without points. Raises InputError unless `allow`."""
    if not allow:
        raise InputError(
            f"expected 3D points in {source} of {capture.root}, found none; give some with --points FILE or start from random ones with "
            f"--init random"
        )
    return replace(capture, warnings=(*capture.warnings, "no 3D points: train with --points FILE or --init random"))


def _finish(capture: Capture) -> Capture:
    """Convert cameras to float32 and add the warnings that concern the whole capture."""
    views = tuple(replace(v, camera=v.camera.to(dtype=torch.float32)) for v in capture.views)
    for view in views:
        expect_range(view.camera.world_to_cam, "camera poses", -FARTHEST, FARTHEST)
        expect_range(view.camera.K, "camera parameters")
    if capture.points is not None:
        expect_range(capture.points.xyz, "positions of points", -FARTHEST, FARTHEST)
    number(capture.extent, "the extent of the cameras", 1e-12, FARTHEST)
    notes = list(capture.warnings)
    if 0 < len(capture.test) < 5:
        held = f"only {len(capture.test)} held-out view{'s' if len(capture.test) > 1 else ''}"
        notes.append(f"{held}: their mean says little; trainings with --split fold:1/5 to fold:5/5 score every photograph")
    notes += tell_copies(views)
    far = max(float(v.camera.position.abs().max()) for v in views) if capture.world.identity else 0.0  # else they are around the origin
    if far * 2.0**-23 > FINEST * capture.extent:
        notes.append(
            f"the cameras are up to {far:,.0f} from the origin, where float32 cannot hold what they see; leave --normalise none out"
        )
    sizes = {(v.camera.width, v.camera.height) for v in views}
    if len(sizes) > 1:
        notes.append(f"views of {len(sizes)} sizes")
    notes += prepare.tell_stretched((float(view.camera.K[0, 0]), float(view.camera.K[1, 1])) for view in views)
    if capture.points is not None and len(capture.points.xyz) < 500:
        notes.append(f"only {len(capture.points.xyz)} points to start from")
    return replace(capture, views=views, warnings=tuple(map(sentence, notes)))  # they quote names of files
