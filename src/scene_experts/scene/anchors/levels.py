"""The lattices of Octree-GS: L levels of cells, each `fork` times as fine as the one before, and which level a distance asks for."""

from __future__ import annotations

import logging
import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any, Literal

import numpy as np
import torch
from torch import Tensor

from scene_experts.core.types import Camera
from scene_experts.geometry.voxel import AXIS_LIMIT, find_unique_cells, to_lattice

log: logging.Logger = logging.getLogger(__name__)
LevelRule = Literal["round", "floor", "ceil", "blend"]
MOST_CELLS = AXIS_LIMIT - 1  # of an axis of the cube, at any level


@dataclass(frozen=True)
class Levels:
    """Everything about the levels that no row of the table says. Lengths in trained world units."""

    count: int  # L
    first: int  # coarse-to-fine training begins with levels 0 .. first
    fork: int
    edge: float  # of a cell of level 0
    origin: tuple[float, float, float]  # the centre of cell (0, 0, 0) of every level
    standard: float  # the distance beyond which level 0 is enough
    rule: LevelRule
    threshold: float  # anchors that no larger share of the cameras asks for are weeded out
    cameras: tuple[tuple[float, float, float], ...]  # centres of the training cameras

    def size(self, level: int) -> float:
        """Edge of a cell of `level`."""
        return self.edge / self.fork**level

    def units(self, points: Tensor, level: int) -> Tensor:
        """Points [P, 3] in cells of `level`, float64; rounded, the cells they fall into."""
        return (points.double() - torch.tensor(self.origin, dtype=torch.float64, device=points.device)) / self.size(level)

    def cells(self, points: Tensor, level: int) -> Tensor:
        """Cells [P, 3] int64 of `level` that points [P, 3] fall into."""
        return to_lattice(self.units(points, level), 1.0)

    def positions(self, cells: Tensor, level: int) -> Tensor:
        """Centres [n, 3] float64 of cells of `level`."""
        return cells.double() * self.size(level) + torch.tensor(self.origin, dtype=torch.float64, device=cells.device)

    def asked(self, xyz: Tensor, level: Tensor, camera: Tensor) -> Tensor:
        """The real-valued level [n] that a camera at `camera` [3] asks for at anchors xyz [n, 3] of `level` [n]:
        log_fork(standard / r), r the distance to the anchor moved by half a cell (Octree-GS)."""
        halves = xyz.new_tensor([0.5 * self.size(i) for i in range(self.count)])
        v = xyz - camera.to(xyz) + halves.index_select(0, level)[:, None]
        r = v.norm(dim=1).clamp_min(1e-12)
        return torch.log(self.standard / r) / math.log(self.fork)

    def share(self, xyz: Tensor, level: Tensor) -> Tensor:
        """The share [n] of the training cameras that ask for each anchor's level or a finer one."""
        total = torch.zeros(len(xyz), dtype=torch.int64, device=xyz.device)
        for centre in torch.tensor(self.cameras, dtype=xyz.dtype, device=xyz.device):
            total += level <= whole(self.asked(xyz, level, centre), self.rule, self.count)
        return total.double() / len(self.cameras)

    def wanted(self, xyz: Tensor, level: Tensor) -> Tensor:
        """Which anchors [n] (bool) weeding leaves: those that more than the threshold's share of the cameras, or all of them, ask for."""
        share = self.share(xyz, level)
        return (share > self.threshold) | (share >= 1)

    def meta(self) -> dict[str, Any]:
        """Plain values for a checkpoint."""
        return asdict(self)

    @classmethod
    def from_meta(cls, meta: dict[str, Any]) -> Levels:
        x, y, z = meta["origin"]
        return cls(**{**meta, "origin": (x, y, z), "cameras": tuple(tuple(c) for c in meta["cameras"])})


def whole(asked: Tensor, rule: LevelRule, top: int) -> Tensor:
    """The finest level [n] int64 in use, of levels 0 .. top - 1, where real-valued levels [n] are asked for.

    `blend` lets in one more level than floor would: the finest one, on its way in.
    """
    if rule == "blend":
        return blended(asked, top).floor().long()
    rounded = {"round": torch.round, "floor": torch.floor, "ceil": torch.ceil}[rule](asked)
    return rounded.clamp(0, top - 1).long()


def blended(asked: Tensor, top: int) -> Tensor:
    """Level plus one [n], held in [0.9999, top - 0.0001]: its floor is the finest level, its fraction that level's weight (Octree-GS)."""
    return (asked + 1).clamp(0.9999, top - 1 + 0.9999)


def distances(points: Tensor, cameras: Sequence[Camera], ratio: float) -> tuple[float, float]:
    """(far, near): quantiles of the distances of points [P, 3] from the cameras, with 1 - `ratio` of the views and points beyond either."""
    xyz, found = points.unique(dim=0).double(), []
    for camera in cameras:
        d = (xyz - camera.position.to(xyz)).norm(dim=1).numpy()
        found += [np.quantile(d, ratio), np.quantile(d, 1 - ratio)]
    return float(np.quantile(found, ratio)), float(np.quantile(found, 1 - ratio))


def centres(cameras: Sequence[Camera]) -> tuple[tuple[float, float, float], ...]:
    """Where cameras are, as plain numbers."""
    found = [camera.position.tolist() for camera in cameras]
    return tuple((x, y, z) for x, y, z in found)


def level_count(far: float, near: float, fork: int) -> int:
    """Levels between two distances: round(log_fork(far / near)) + 1."""
    return max(1, round(math.log(far / near, fork)) + 1) if near > 0 else 1


def cube(points: Tensor, extend: float, parity: bool = False) -> tuple[float, float]:
    """(low corner, edge) of the cube that holds points [P, 3], `extend` times as large, the same on all axes.

    parity: the ends are multiplied as they are, as Octree-GS does, which shrinks a cube that does not hold the origin.
    """
    low, high = float(points.min()), float(points.max())
    if parity:
        return extend * low, extend * (high - low)
    edge = extend * max(high - low, 1e-9)
    return 0.5 * (low + high - edge), edge


def within_reach(count: int, edge: float, cube_edge: float, fork: int) -> int:
    """At most so many levels that the finest one's cell numbers still fit."""
    most = count
    while most > 1 and cube_edge / (edge / fork ** (most - 1)) >= MOST_CELLS:
        most -= 1
    if most < count:
        log.warning("%d levels of detail instead of %d: finer cells than that cannot be told apart", most, count)
    return most


def occupied(levels: Levels, points: Tensor) -> tuple[Tensor, Tensor]:
    """Cells [n, 3] and levels [n] of every level's occupied cells, coarse to fine."""
    per_level = [find_unique_cells(levels.cells(points, level))[0] for level in range(levels.count)]
    level = torch.cat([torch.full((len(cells),), i) for i, cells in enumerate(per_level)])
    return torch.cat(per_level), level
