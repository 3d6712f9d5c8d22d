"""Divides a capture into blocks: boxes that hold equal numbers of its points, each with the
training views that see it.

The boxes fill all of space and do not overlap, so every anchor lies in exactly one of them. The
idea of blocks whose views are chosen by visibility is that of CityGaussian (Liu et al. 2024) and of
VastGaussian (Lin et al. 2024).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from scene_experts.core.errors import InputError
from scene_experts.core.io import write_json
from scene_experts.core.reading.budget import CAPTURE
from scene_experts.core.reading.numbers import number
from scene_experts.core.reading.plain import read_json
from scene_experts.core.reading.source import guarding
from scene_experts.data.views import Capture, View

FORMAT = 1
FAR = 1e30  # stands for an infinite side where only finite numbers are written
MOST_POINTS = 200_000  # of a capture that decide about its blocks; evenly chosen


@dataclass(frozen=True)
class Block:
    """A box, in trained world units, and the names of the training views that see it. Outer sides
    of the outer boxes are infinite."""

    low: tuple[float, ...]
    high: tuple[float, ...]
    views: tuple[str, ...] = ()
    margin: float = 0.0
    """How far beyond its box a block is trained, in trained world units."""

    @property
    def bounds(self) -> tuple[float, ...]:
        """The low and the high corner (x, y, z, x, y, z) of the box with its margin. Infinite sides
        are at +-1e30."""
        sides = [side - self.margin for side in self.low] + [side + self.margin for side in self.high]
        return tuple(min(max(side, -FAR), FAR) for side in sides)

    def holds(self, xyz: Tensor, margin: float = 0.0) -> Tensor:
        """Return which positions [N, 3] lie in the box, [N] bool. Its low sides belong to it, its
        high sides do not.

        margin: distance by which all sides are moved outwards.
        """
        low, high = (torch.tensor(side, dtype=xyz.dtype, device=xyz.device) for side in (self.low, self.high))
        return ((xyz >= low - margin) & (xyz < high + margin)).all(1)


def make_blocks(capture: Capture, count: int, margin: float = 0.1, share: float = 0.1) -> list[Block]:
    """Divide a capture into `count` blocks.

    Args:
        margin: A view is chosen by the points in the block and around it, up to this share of the
            block's size.
        share: A view belongs to a block if at least this share of the points in the picture lie in
            the enlarged block. Every view belongs at least to the block of which it sees most.

    Raises:
        InputError: The capture has no points, the numbers are out of range, or a block would have
            no point or no view.
    """
    if capture.points is None or len(capture.points.xyz) < count:
        raise InputError(f"expected at least {count} points in {capture.root} for {count} blocks, found fewer; give smaller --blocks")
    xyz = capture.points.xyz.double()
    xyz = xyz[:: -(-len(xyz) // MOST_POINTS)]
    boxes = split_box(xyz, Block((-math.inf,) * 3, (math.inf,) * 3), count)
    margins = [margin * float(_size(xyz[box.holds(xyz)]).max()) for box in boxes]
    reach = [box.holds(xyz, distance) for box, distance in zip(boxes, margins)]
    views: list[list[str]] = [[] for _ in boxes]
    for index in capture.train:
        view = capture.views[index]
        seen = visible(view, xyz)
        shares = torch.stack([(seen & inside).sum() for inside in reach]) / seen.sum().clamp_min(1)
        for i in range(len(boxes)):
            if shares[i] >= max(share, 1e-9) or i == int(shares.argmax()):
                views[i].append(view.name)
    if empty := [number for number, names in enumerate(views) if not names]:
        raise InputError(f"expected views that see each block, found none for block {empty[0]}; give smaller --blocks or --share")
    return [Block(box.low, box.high, tuple(names), distance) for box, names, distance in zip(boxes, views, margins)]


def split_box(xyz: Tensor, box: Block, count: int) -> list[Block]:
    """Split a box into `count` boxes with equal numbers of the points [N, 3], each time across its
    longest side.

    Raises InputError if a box would have no point, because too many points have the same
    coordinate.
    """
    if count == 1:
        return [box]
    first = count // 2
    axis = int(_size(xyz).argmax())
    at = float(xyz[:, axis].sort().values[len(xyz) * first // count])
    low, high = list(box.low), list(box.high)
    low[axis] = high[axis] = at
    below = xyz[:, axis] < at
    if not below.any():
        same = int((xyz[:, axis] == at).sum())
        raise InputError(
            f"expected points that can be divided into {count} blocks, found {same} with the same coordinate; give smaller --blocks"
        )
    left, right = Block(box.low, tuple(high)), Block(tuple(low), box.high)
    return split_box(xyz[below], left, first) + split_box(xyz[~below], right, count - first)


def visible(view: View, xyz: Tensor) -> Tensor:
    """Return which points [N, 3] lie in the picture of a view and beyond its near plane, [N] bool.
    Occlusion is ignored."""
    camera = view.camera
    pose, K = camera.world_to_cam.to(xyz), camera.K.to(xyz)
    local = xyz @ pose[:3, :3].T + pose[:3, 3]
    depth = local[:, 2]
    x, y = (local @ K.T)[:, :2].T / depth
    return (depth > camera.near) & (x >= 0) & (x < camera.width) & (y >= 0) & (y < camera.height)


def _size(xyz: Tensor) -> Tensor:
    """Return the lengths [3] of the box that holds nine tenths of the points [N, 3] in each
    direction."""
    ordered = xyz.sort(0).values
    return ordered[int(0.95 * (len(xyz) - 1))] - ordered[int(0.05 * (len(xyz) - 1))]


def write_plan(folder: Path, capture: Capture, blocks: list[Block]) -> None:
    """Write `folder`/plan.json, and `folder`/blockN.json with the names of the views of block N."""
    for i, block in enumerate(blocks):
        write_json(folder / f"block{i}.json", list(block.views))
    boxes = [{"low": _plain(b.low), "high": _plain(b.high), "margin": b.margin, "views": list(b.views)} for b in blocks]
    write_json(folder / "plan.json", {"format": FORMAT, "capture": capture.fingerprint(), "blocks": boxes})


def read_plan(folder: Path) -> tuple[str, list[Block]]:
    """Return the fingerprint of the capture and the blocks of a plan. Raises InputError if `folder`
    holds no plan."""
    path = folder / "plan.json"
    if not path.is_file():
        raise InputError(f"expected plan.json in {folder}, found none; make a plan with `scene-experts blocks plan`")
    value: Any = read_json(path, "plan of blocks")
    with guarding(path, CAPTURE, "plan of blocks"):
        if value["format"] != FORMAT:
            raise InputError(f"expected a plan of format {FORMAT} in {path}, found another; make it again")
        return str(value["capture"]), [
            Block(
                _side(box["low"], -math.inf),
                _side(box["high"], math.inf),
                tuple(map(str, box["views"])),
                number(box.get("margin", 0.0), "the margin of a block", 0.0),
            )
            for box in value["blocks"]
        ]


def read_view_names(path: Path) -> list[str]:
    """Return the names of views in a JSON file. Raises InputError if it is not a list of names."""
    value = read_json(path, "list of views") if path.is_file() else None
    if not isinstance(value, list) or not value or not all(isinstance(name, str) for name in value):
        raise InputError(f"expected a JSON list of names of views in {path}, found something else; correct --views")
    return value


def _plain(side: tuple[float, ...]) -> list[float | None]:
    """Return a corner as JSON, with null for infinity."""
    return [value if math.isfinite(value) else None for value in side]


def _side(values: list[float | None], outside: float) -> tuple[float, ...]:
    x, y, z = (outside if value is None else float(value) for value in values)
    return (x, y, z)
