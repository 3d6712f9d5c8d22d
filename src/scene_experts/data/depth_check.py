"""Compares the depth maps of a capture with its points, which must have one unit."""

from __future__ import annotations

import math
from collections.abc import Collection
from dataclasses import replace

import torch
from torch import Tensor

from scene_experts.core.errors import InputError
from scene_experts.core.types import Camera
from scene_experts.data.projection import project
from scene_experts.data.views import Capture

BLOCK = 8  # px: of the points in one block, the nearest is compared, for the others may be hidden
FEWEST = 20  # points of a view that say something
AGREE = 1.1  # ratio of depths up to which maps and points have one unit


def check_depths(capture: Capture) -> Capture:
    """Return the capture without those depth maps whose depths are not those of its points, and with
    a note; without all of them where that is true of most.

    Maps that a network has guessed, or in another unit than the poses, would bend the scene in
    silence. So are maps that cannot be read.
    """
    having = [i for i, view in enumerate(capture.views) if view.depth is not None]
    if not having or capture.points is None or capture.random_points:
        return capture
    ratios: dict[int, float] = {}
    damaged: dict[int, InputError] = {}
    for i in having:
        try:
            if (ratio := find_ratio(capture, i)) is not None:
                ratios[i] = ratio
        except InputError as error:
            damaged[i] = error
    if damaged:
        capture = _without(
            capture, damaged, f"{len(damaged)} of {len(having)} depth maps are left out (first: {next(iter(damaged.values()))})"
        )
        having = [i for i in having if i not in damaged]
    wrong = [i for i, ratio in ratios.items() if abs(math.log(ratio)) > math.log(AGREE)]
    if not wrong:
        return capture
    out = set(having if 2 * len(wrong) > len(ratios) else wrong)
    found = sorted(ratios[i] for i in wrong)
    times = f"{found[0]:.3g}" if found[-1] <= AGREE * found[0] else f"{found[0]:.3g} to {found[-1]:.3g}"
    note = (
        f"{len(out)} of {len(having)} depth maps are left out: the points lie at {times} times their depth; "
        f"give maps in thousandths of the unit of the poses"
    )
    return _without(capture, out, note)


def _without(capture: Capture, left_out: Collection[int], note: str) -> Capture:
    """Return the capture without the depth maps of some views, and with a note."""
    views = tuple(replace(view, depth=None) if i in left_out else view for i, view in enumerate(capture.views))
    return replace(capture, views=views, warnings=(*capture.warnings, note))


def find_ratio(capture: Capture, index: int) -> float | None:
    """Return the median ratio of the depth of points to that of the map of view `index`; None where
    too few points say something."""
    assert capture.points is not None
    depth = capture.depth(index)
    assert depth is not None
    columns, rows, z = find_pixels(capture.points.xyz, capture.views[index].camera, (depth.shape[1], depth.shape[0]))
    across = depth.shape[1] // BLOCK + 1
    order = z.argsort()
    blocks = ((rows // BLOCK) * across + columns // BLOCK)[order]
    first = torch.full((across * (depth.shape[0] // BLOCK + 1),), len(z)).scatter_reduce(0, blocks, torch.arange(len(z)), "amin")
    nearest = order[first[first < len(z)]]
    there = depth[rows[nearest], columns[nearest]].double()
    known = there > 0
    return float((z[nearest][known] / there[known]).median()) if int(known.sum()) >= FEWEST else None


def find_pixels(xyz: Tensor, camera: Camera, size: tuple[int, int]) -> tuple[Tensor, Tensor, Tensor]:
    """Return the columns, rows and depths [n] of those points that a camera sees, in a picture of
    `size` of all that it shows."""
    u, v, z = project(xyz, camera)
    columns = (u * (size[0] / camera.width)).floor()
    rows = (v * (size[1] / camera.height)).floor()
    seen = (z > camera.near) & (columns >= 0) & (columns < size[0]) & (rows >= 0) & (rows < size[1])
    return columns[seen].long(), rows[seen].long(), z[seen]
