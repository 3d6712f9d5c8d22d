"""Pure functions from a capture to a capture: choose views, hold some out, change the resolution, move and scale the world, drop outliers.

`load` is built from them; each can also be called on a loaded capture. None reads a pixel and none changes its argument.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from scene_experts.core.errors import InputError
from scene_experts.core.types import Camera, Points
from scene_experts.data.images import check_policy, target_size
from scene_experts.data.lens import pinhole_of
from scene_experts.data.store import ImageStore
from scene_experts.data.views import Capture, View, World

RANDOM_POINTS = 10_000  # as 3DGS starts NeRF-synthetic scenes
NORMAL_EXTENT = 5.0  # R of a capture trained in a normalised world
_FAR_VIEW = 50.0  # a camera further from the median camera than this many median distances was mislocated
_FAR_POINT = (50.0, 20.0)  # a point further than both 50 R and 20 median distances from the cameras is noise


def centres(views: Sequence[View]) -> Tensor:
    """Camera centres [V, 3] float64."""
    return torch.stack([view.camera.to(dtype=torch.float64).position for view in views])


def extent(capture: Capture) -> float:
    """R: 1.1 x the largest distance of a training camera from the mean of the training cameras (3DGS's "cameras extent").

    Where that is 0 (one camera, or all in one place) the median distance of the points from there, and 1 without points.
    """
    xyz = centres([capture.views[i] for i in capture.train])
    middle = xyz.mean(0)
    radius = 1.1 * float((xyz - middle).norm(dim=1).max())
    if radius > 1e-9 * max(1.0, float(middle.norm())):
        return radius
    away = (middle.new_zeros(0, 3) if capture.points is None else capture.points.xyz - middle).norm(dim=1)
    away = away[away.isfinite()]
    return float(away.median()) or 1.0 if len(away) else 1.0


def near_plane(radius: float) -> float:
    """The near plane of a world of extent `radius`: 0.2 as in 3DGS, less in small worlds, so that no unit loses its geometry to it."""
    return min(0.2, 0.02 * radius)


def measured(capture: Capture) -> Capture:
    """`capture` with its extent and near planes taken from its training cameras anew."""
    radius = extent(capture)
    views = tuple(replace(v, camera=replace(v.camera, near=near_plane(radius))) for v in capture.views)
    return replace(capture, views=views, extent=radius)


def subset(capture: Capture, indices: Sequence[int]) -> Capture:
    """Only the views `indices`, in order; the split is kept for those that remain."""
    order = sorted(set(indices))
    new = {old: i for i, old in enumerate(order)}
    views = tuple(replace(capture.views[i], camera=replace(capture.views[i].camera, id=new[i])) for i in order)
    store = ImageStore([capture.images.sources[i] for i in order], capture.images.cache_bytes)
    train, test = (tuple(new[i] for i in part if i in new) for part in (capture.train, capture.test))
    return replace(capture, views=views, images=store, train=train, test=test)


def at_most(capture: Capture, count: int) -> Capture:
    """At most `count` views, spread evenly over the names in order."""
    if count < 1:
        raise InputError(f"expected --max-views of at least 1, found {count}; give a positive number or leave it out")
    total = len(capture.views)
    return capture if total <= count else subset(capture, [int(i * total / count) for i in range(count)])


def hold_out(capture: Capture, split: str) -> Capture:
    """Divide the views, sorted by their whole name, into training and test views.

    "modN" or "mod:N": every Nth is a test view, starting with the first ("mod8" is the protocol of 3DGS and its kin); "first:N": the
    first N are; "none": none is; "files": as the capture's files say. Raises InputError for another word or where no training view is left.
    """
    every, first = split.removeprefix("mod").removeprefix(":"), split.removeprefix("first:")
    indices = range(len(capture.views))
    if split == "files":
        test = capture.test
        if not test and capture.kind != "blender":
            found = "a COLMAP capture" if capture.kind == "colmap" else "no test views in transforms.json"
            raise InputError(f"expected a capture whose files hold a split for --split files, found {found}; use --split mod8")
    elif split == "none":
        test = ()
    elif split.startswith("mod") and every.isdecimal() and int(every) >= 2:
        test = tuple(i for i in indices if i % int(every) == 0)
    elif split.startswith("first:") and first.isdecimal() and int(first) >= 1:
        test = tuple(indices[: int(first)])
    else:
        raise InputError(f"expected --split mod8 (or another modN), first:N, none or files, found {split!r}; choose one")
    held = set(test)
    train = tuple(i for i in indices if i not in held)
    if not train:
        raise InputError(
            f"expected training views after --split {split}, found none among {len(indices)} views; use --split none or a smaller test set"
        )
    return replace(capture, train=train, test=test, split=split.replace("mod:", "mod"))


def downscale(capture: Capture, policy: str) -> Capture:
    """Views at the resolution that `policy` (see `images.target_size`) makes of each undistorted photograph; intrinsics scaled exactly."""
    policy = check_policy(policy)
    views, sources = [], []
    for view, source in zip(capture.views, capture.images.sources):
        full = pinhole_of(source.lens)
        size = target_size(policy, (full.width, full.height))
        sources.append(replace(source, size=size))
        views.append(replace(view, camera=_resized(view.camera, size)))
    return replace(capture, views=tuple(views), images=ImageStore(sources, capture.images.cache_bytes), resolution=policy)


def _resized(camera: Camera, size: tuple[int, int]) -> Camera:
    ratio = torch.tensor([[size[0] / camera.width], [size[1] / camera.height], [1.0]], dtype=torch.float64)
    return replace(camera, K=(camera.K.double() * ratio).to(camera.K.dtype), width=size[0], height=size[1])


def moved(capture: Capture, shift: tuple[float, float, float], scale: float) -> Capture:
    """The capture in the world (trained + shift) * scale: cameras, points, extent and near planes; `world` undoes it."""
    step = World(scale, shift)
    views = tuple(replace(v, camera=step.camera_from_input(v.camera)) for v in capture.views)
    points = capture.points and Points(step.from_input(capture.points.xyz), capture.points.rgb)
    out = replace(capture, views=views, points=points, world=capture.world.then(shift, scale), extent=capture.extent * scale)
    near = near_plane(out.extent)
    return replace(out, views=tuple(replace(v, camera=replace(v.camera, near=near)) for v in out.views))


def scaled(capture: Capture, factor: float) -> Capture:
    """The capture with every length multiplied by `factor`."""
    return moved(capture, (0.0, 0.0, 0.0), factor)


def normalised(capture: Capture) -> Capture:
    """The capture in a world whose origin is the mean training camera and whose extent is 5, whatever unit it came in."""
    x, y, z = (-centres([capture.views[i] for i in capture.train]).mean(0)).tolist()
    out = moved(capture, (x, y, z), NORMAL_EXTENT / capture.extent)
    near = near_plane(NORMAL_EXTENT)  # set, not computed, so that captures of different units agree to the last bit here
    return replace(out, extent=NORMAL_EXTENT, views=tuple(replace(v, camera=replace(v.camera, near=near)) for v in out.views))


def drop_outlier_views(capture: Capture) -> Capture:
    """Without the views whose camera is more than 50 median distances from the median camera; such poses are errors and wreck the extent.

    Captures of fewer than 8 views are left alone.
    """
    xyz = centres(capture.views)
    distance = (xyz - xyz.median(0).values).norm(dim=1)
    bad = distance > _FAR_VIEW * distance.median()
    if len(xyz) < 8 or not bool(bad.any()) or float(distance.median()) == 0.0:
        return capture
    first = capture.views[int(bad.nonzero()[0])].name
    note = f"{int(bad.sum())} views dropped whose camera is over {_FAR_VIEW:.0f} times further out than most (first: {first})"
    return replace(subset(capture, (~bad).nonzero().flatten().tolist()), warnings=(*capture.warnings, note))


def drop_outliers(capture: Capture) -> Capture:
    """Without the points that are not finite or further from the mean training camera than both 50 R and 20 median distances.

    Both limits together, because a short arc of cameras may rightly look at things hundreds of R away.
    """
    if capture.points is None:
        return capture
    xyz = capture.points.xyz
    distance = (xyz - centres([capture.views[i] for i in capture.train]).mean(0)).norm(dim=1)
    finite = torch.isfinite(distance)
    if not bool(finite.any()):
        return replace(capture, points=None)
    limit = max(_FAR_POINT[0] * capture.extent, _FAR_POINT[1] * float(distance[finite].median()))
    keep = finite & (distance <= limit)
    dropped = int((~keep).sum())
    if not dropped:
        return capture
    note = f"{dropped} of {len(xyz)} points dropped: not finite, or over {limit / capture.extent:.0f} extents from the cameras"
    return replace(capture, points=Points(xyz[keep], capture.points.rgb[keep]), warnings=(*capture.warnings, note))


def random_points(capture: Capture, count: int = RANDOM_POINTS, seed: int = 0) -> Capture:
    """The capture with `count` near-grey points spread uniformly, in place of any it has.

    NeRF-synthetic scenes: the cube [-1.3, 1.3]^3 of their own frame, as 3DGS does. Others: the box of the training cameras and of what lies
    one and a half extents in front of each, which holds the subject both of all-round and of forward-facing captures.
    """
    rng = np.random.default_rng(seed)
    if capture.kind == "blender":
        corners = capture.world.from_input(torch.tensor([[-1.3] * 3, [1.3] * 3], dtype=torch.float64))
    else:
        views = [capture.views[i] for i in capture.train]
        eyes = centres(views)
        ahead = torch.stack([v.camera.world_to_cam[2, :3].double() for v in views])
        both = torch.cat((eyes, eyes + 1.5 * capture.extent * ahead))
        corners = torch.stack((both.amin(0), both.amax(0)))
    xyz = corners[0] + torch.from_numpy(rng.random((count, 3))) * (corners[1] - corners[0])
    grey = torch.from_numpy(rng.integers(118, 138, (count, 3)).astype(np.uint8))
    return replace(capture, points=Points(xyz, grey))
