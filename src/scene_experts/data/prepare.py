"""Functions from a capture to a capture: select views, split, resize, transform the world, drop
outliers, add random points; and what is told of lenses.

`load` is built from them, and each can be applied to a loaded capture. They read no pixels and do
not modify their argument.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Sequence
from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from scene_experts.core.errors import InputError
from scene_experts.core.types import Camera, Points
from scene_experts.data.images import check_policy, target_size
from scene_experts.data.lens import to_pinhole
from scene_experts.data.store import ImageStore
from scene_experts.data.views import Capture, Vector, View, World

RANDOM_POINTS = 10_000  # as 3DGS for NeRF-synthetic scenes
STRETCHED = 1.1  # ratio of two focal lengths from which on no lens has them
FEW = 12  # with fewer views, all are trained on unless the user holds some out
NORMAL_EXTENT = 5.0  # extent of a capture in a normalised world
_FAR_VIEW = 50.0  # a camera further from the median camera than this many median distances is mislocated
_ONE_PLACE = 1e-9  # of the median distance from the origin: views nearer to each other are of one place
_FAR_POINT = (50.0, 20.0)  # a point further from the cameras than both 50 extents and 20 median distances is noise


def camera_centres(views: Sequence[View]) -> Tensor:
    """Return the camera centres [V, 3] float64."""
    return torch.stack([view.camera.to(dtype=torch.float64).position for view in views])


def camera_extent(capture: Capture) -> float:
    """Return 1.1 times the largest distance of a training camera from the mean training camera
    ("cameras extent" in 3DGS).

    If all training cameras are at one place, return the median distance of the points from there,
    or 1 without points.
    """
    xyz = camera_centres([capture.views[i] for i in capture.train])
    middle = xyz.mean(0)
    radius = 1.1 * float((xyz - middle).norm(dim=1).max())
    if radius > 1e-9 * max(1.0, float(middle.norm())):
        return radius
    away = (middle.new_zeros(0, 3) if capture.points is None else capture.points.xyz - middle).norm(dim=1)
    away = away[away.isfinite()]
    return float(away.median()) or 1.0 if len(away) else 1.0


def near_plane(extent: float) -> float:
    """Return the near plane for a world of this extent: 0.2 as in 3DGS, or less in small worlds so
    that nothing is clipped."""
    return min(0.2, 0.02 * extent)


def measure_extent(capture: Capture) -> Capture:
    """Set the extent and the near planes from the training cameras."""
    return _with_near(replace(capture, extent=camera_extent(capture)))


def _with_near(capture: Capture) -> Capture:
    near = near_plane(capture.extent)
    return replace(capture, views=tuple(replace(v, camera=replace(v.camera, near=near)) for v in capture.views))


def select_views(capture: Capture, indices: Sequence[int]) -> Capture:
    """Keep only the views `indices`, in ascending order. Views keep their part of the split."""
    order = sorted(set(indices))
    new = {old: i for i, old in enumerate(order)}
    views = tuple(replace(capture.views[i], camera=replace(capture.views[i].camera, id=new[i])) for i in order)
    store = ImageStore([capture.images.sources[i] for i in order], capture.images.cache_bytes)
    train, test = (tuple(new[i] for i in part if i in new) for part in (capture.train, capture.test))
    return replace(capture, views=views, images=store, train=train, test=test)


def limit_views(capture: Capture, count: int) -> Capture:
    """Keep at most `count` views, spread evenly over the sorted names. Raises InputError if `count`
    is below 1."""
    if count < 1:
        raise InputError(f"expected --max-views of at least 1, found {count}; give a positive number or omit the option")
    total = len(capture.views)
    return capture if total <= count else select_views(capture, [int(i * total / count) for i in range(count)])


def hold_out(capture: Capture, split: str) -> Capture:
    """Divide the views, sorted by name, into training and test views.

    Args:
        split: "modN" or "mod:N" holds out every Nth view, beginning with the first ("mod8" is the
            protocol of 3DGS); "fold:K/N" holds out every Nth view, beginning with the Kth, so that
            the folds 1/N to N/N hold out each view once; "first:N" holds out the first N; "none"
            holds out none; "files" keeps the split that the files state.

    Raises:
        InputError: for another word, if the files state no split, or if no training view is left.
    """
    every, first = split.removeprefix("mod").removeprefix(":"), split.removeprefix("first:")
    fold = re.fullmatch(r"fold:([1-9]\d*)/([1-9]\d*)", split)
    indices = range(len(capture.views))
    if split == "files":
        test = capture.test
        if not test and not capture.states_split:
            raise InputError(
                f"expected test views in the files of {capture.name} for --split files, found none in this {capture.kind} capture; "
                f"use --split mod8"
            )
    elif split == "none":
        test = ()
    elif split.startswith("mod") and every.isdecimal() and int(every) >= 2:
        test = tuple(i for i in indices if i % int(every) == 0)
    elif fold is not None and int(fold[1]) <= int(fold[2]) > 1:
        test = tuple(i for i in indices if i % int(fold[2]) == int(fold[1]) - 1)
    elif split.startswith("first:") and first.isdecimal() and int(first) >= 1:
        test = tuple(indices[: int(first)])
    else:
        raise InputError(f"expected --split mod8 (or another modN), fold:K/N, first:N, none or files, found {split!r}; choose one")
    if fold is not None and not test:
        raise InputError(
            f"expected a fold that holds out a view for --split {split}, found {len(capture.views)} views; use at most so many folds"
        )
    held = set(test)
    train = tuple(i for i in indices if i not in held)
    if not train:
        raise InputError(
            f"expected training views after --split {split}, found none among {len(indices)} views; use --split none or a smaller test set"
        )
    return replace(capture, train=train, test=test, split=split.replace("mod:", "mod"))


def downscale(capture: Capture, policy: str) -> Capture:
    """Resize each undistorted photograph as `policy` says (see `images.target_size`), and scale its
    intrinsics exactly."""
    policy = check_policy(policy)
    views, sources = [], []
    for view, source in zip(capture.views, capture.images.sources):
        full = to_pinhole(source.lens)
        size = target_size(policy, (full.width, full.height))
        sources.append(replace(source, size=size))
        views.append(replace(view, camera=_resize_camera(view.camera, size)))
    return replace(capture, views=tuple(views), images=ImageStore(sources, capture.images.cache_bytes), resolution=policy)


def limit_size(capture: Capture, longest: int, cache_bytes: int) -> Capture:
    """Resize the views whose longer side exceeds `longest` px. The frames have a cache of their
    own, of at most `cache_bytes`."""
    views, sources = [], []
    for view, source in zip(capture.views, capture.images.sources):
        size = target_size(f"longest:{longest}", source.size)
        sources.append(replace(source, size=size))
        views.append(replace(view, camera=_resize_camera(view.camera, size)))
    store = ImageStore(sources, min(cache_bytes, capture.images.cache_bytes))
    return replace(capture, views=tuple(views), images=store)


def _resize_camera(camera: Camera, size: tuple[int, int]) -> Camera:
    ratio = torch.tensor([[size[0] / camera.width], [size[1] / camera.height], [1.0]], dtype=torch.float64)
    return replace(camera, K=(camera.K.double() * ratio).to(camera.K.dtype), width=size[0], height=size[1])


def transform(capture: Capture, shift: Vector, scale: float) -> Capture:
    """Map cameras, points, extent and near planes by `(trained + shift) * scale`, and extend
    `world` by that step."""
    return _with_near(_move(capture, shift, scale))


def _move(capture: Capture, shift: Vector, scale: float) -> Capture:
    """`transform` without the near planes."""
    step = World(scale, shift)
    views = tuple(replace(v, camera=step.camera_from_input(v.camera)) for v in capture.views)
    points = capture.points and Points(step.from_input(capture.points.xyz), capture.points.rgb)
    world = capture.world.then(shift, scale)
    return replace(capture, views=views, points=points, world=world, extent=capture.extent * scale)


def scale(capture: Capture, factor: float) -> Capture:
    """Multiply every length by `factor`."""
    return transform(capture, (0.0, 0.0, 0.0), factor)


def normalise(capture: Capture) -> Capture:
    """Move the origin to the mean training camera and scale the extent to 5, whatever the unit of
    the capture is."""
    x, y, z = (-camera_centres([capture.views[i] for i in capture.train]).mean(0)).tolist()
    out = _move(capture, (x, y, z), NORMAL_EXTENT / capture.extent)
    return _with_near(replace(out, extent=NORMAL_EXTENT))  # exactly 5, so that captures in different units agree to the last bit


def drop_outlier_views(capture: Capture) -> Capture:
    """Drop the views whose camera is more than 50 median distances from the median camera. Such
    poses are errors and distort the extent.

    Views of one place, such as those of a panorama, count as one. A capture of fewer than 8 places
    is not changed.
    """
    xyz = camera_centres(capture.views)
    step = _ONE_PLACE * float(xyz.norm(dim=1).median())
    places = torch.unique((xyz / step).round(), dim=0) * step if step else xyz
    middle = places.median(0).values
    usual, distance = float((places - middle).norm(dim=1).median()), (xyz - middle).norm(dim=1)
    bad = distance > _FAR_VIEW * usual
    if len(places) < 8 or not bool(bad.any()) or usual == 0:
        return capture
    first = capture.views[int(bad.nonzero()[0])].name
    note = f"dropped {int(bad.sum())} views whose camera is over {_FAR_VIEW:.0f} times further away than most (first: {first})"
    return replace(select_views(capture, (~bad).nonzero().flatten().tolist()), warnings=(*capture.warnings, note))


def drop_outliers(capture: Capture) -> Capture:
    """Drop the points that are not finite or are too far from the mean training camera.

    A point is too far beyond both 50 extents and 20 median distances. Both limits are needed
    because cameras on a short arc may see things hundreds of extents away.
    """
    if capture.points is None:
        return capture
    xyz = capture.points.xyz
    distance = (xyz - camera_centres([capture.views[i] for i in capture.train]).mean(0)).norm(dim=1)
    finite = torch.isfinite(distance)
    if not bool(finite.any()):
        return replace(capture, points=None)
    limit = max(_FAR_POINT[0] * capture.extent, _FAR_POINT[1] * float(distance[finite].median()))
    keep = finite & (distance <= limit)
    dropped = int((~keep).sum())
    if not dropped:
        return capture
    note = f"dropped {dropped} of {len(xyz)} points that are not finite or over {limit / capture.extent:.0f} extents from the cameras"
    return replace(capture, points=Points(xyz[keep], capture.points.rgb[keep]), warnings=(*capture.warnings, note))


def _is_looked_at(corners: Tensor, views: Sequence[View]) -> bool:
    """Whether most cameras see the centre of a box, from outside and from at most ten times its
    half diagonal."""
    centre, reach = corners.mean(0), float((corners[1] - corners[0]).norm()) / 2
    seeing = 0
    for view in views:
        camera = view.camera.to(dtype=torch.float64)
        x, y, z = (camera.world_to_cam[:3, :3] @ centre + camera.world_to_cam[:3, 3]).tolist()
        u, v = (camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy) if z > 0 else (-1.0, -1.0)
        distance = math.sqrt(x * x + y * y + z * z)
        seeing += 0 <= u <= camera.width and 0 <= v <= camera.height and reach < distance < 10 * reach
    return seeing * 4 >= len(views) * 3


def add_random_points(capture: Capture, count: int = RANDOM_POINTS, seed: int = 0) -> Capture:
    """Replace the points by `count` uniformly distributed, nearly grey points.

    They fill `capture.bounds` if that is known and the cameras look at it from around, as 3DGS does
    for NeRF-synthetic scenes. Otherwise they fill the box of the training cameras and of the places 1.5 extents in front of them, which
    holds the subject of inward-facing and of forward-facing captures.
    """
    rng = np.random.default_rng(seed)
    views = [capture.views[i] for i in capture.train]
    corners = None if capture.bounds is None else capture.world.from_input(torch.tensor(capture.bounds, dtype=torch.float64))
    if corners is None or not _is_looked_at(corners, views):
        eyes = camera_centres(views)
        ahead = torch.stack([v.camera.world_to_cam[2, :3].double() for v in views])
        both = torch.cat((eyes, eyes + 1.5 * capture.extent * ahead))
        corners = torch.stack((both.amin(0), both.amax(0)))
    xyz = corners[0] + torch.from_numpy(rng.random((count, 3))) * (corners[1] - corners[0])
    grey = torch.from_numpy(rng.integers(118, 138, (count, 3)).astype(np.uint8))
    return replace(capture, points=Points(xyz, grey))


def tell_stretched(focal: Iterable[tuple[float, float]]) -> list[str]:
    """Say if two focal lengths (fx, fy) in pixels differ as no lens's do. Photographs that do not
    tell them apart, a drone's from one height, fit a scene that is stretched in the same way."""
    x, y = max(focal, key=lambda pair: max(pair) / max(min(pair), 1e-9), default=(1.0, 1.0))
    if max(x, y) < STRETCHED * min(x, y):
        return []
    return [
        f"a lens has the focal lengths {x:,.0f} and {y:,.0f} px; unless its pixels are no squares, the scene is stretched: find the poses "
        "again with `scene-experts capture`, or with one focal length (COLMAP's RADIAL)"
    ]
