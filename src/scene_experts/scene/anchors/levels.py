"""Lattices of Octree-GS: L levels of cells, each `fork` times finer than the previous one. The
distance selects the level."""

from __future__ import annotations

import logging
import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any, Literal

import numpy as np
import torch
from torch import Tensor

from scene_experts.core.transfer import upload
from scene_experts.core.types import Camera
from scene_experts.geometry.voxel import AXIS_LIMIT, find_unique_cells, to_lattice

log: logging.Logger = logging.getLogger(__name__)
LevelRule = Literal["round", "floor", "ceil", "blend"]
MOST_CELLS = AXIS_LIMIT - 1  # maximum number of cells per axis of the cube, at any level
MOST_LEVELS, MOST_FORK = 64, 1024  # that a checkpoint may have


@dataclass(frozen=True)
class Levels:
    """Properties that all levels share. Lengths are in trained world units."""

    count: int  # L
    first: int  # coarse-to-fine training begins with levels 0 .. first
    fork: int
    edge: float  # edge of a cell of level 0
    origin: tuple[float, float, float]  # the centre of cell (0, 0, 0) of every level
    standard: float  # the distance beyond which level 0 is enough
    rule: LevelRule
    threshold: float  # anchors selected by no larger share of the cameras are removed
    cameras: tuple[tuple[float, float, float], ...]  # centres of the training cameras

    def size(self, level: int) -> float:
        """Return the edge of a cell of `level`."""
        return self.edge / self.fork**level

    def units(self, points: Tensor, level: int) -> Tensor:
        """Return points [P, 3] in cell units of `level`, float64. Rounding them gives their
        cells."""
        return (points.double() - torch.tensor(self.origin, dtype=torch.float64, device=points.device)) / self.size(level)

    def cells(self, points: Tensor, level: int) -> Tensor:
        """Return the cells [P, 3] int64 of `level` that contain points [P, 3]."""
        return to_lattice(self.units(points, level), 1.0)

    def positions(self, cells: Tensor, level: int) -> Tensor:
        """Return the centres [n, 3] float64 of cells of `level`."""
        return cells.double() * self.size(level) + torch.tensor(self.origin, dtype=torch.float64, device=cells.device)

    def asked(self, xyz: Tensor, level: Tensor, camera: Tensor) -> Tensor:
        """Return real-valued levels of detail [n] for anchors xyz [n, 3] of `level` [n] and a
        camera at `camera` [3].

        The value is log_fork(standard / r), where r is the distance to the anchor moved by half a
        cell (Octree-GS).
        """
        halves = upload(torch.tensor([0.5 * self.size(i) for i in range(self.count)], dtype=xyz.dtype), xyz.device)
        v = xyz - camera.to(xyz) + halves.index_select(0, level)[:, None]
        r = v.norm(dim=1).clamp_min(1e-12)
        return torch.log(self.standard / r) / math.log(self.fork)

    def share(self, xyz: Tensor, level: Tensor) -> Tensor:
        """Return the share [n] of the training cameras that select each anchor."""
        total = torch.zeros(len(xyz), dtype=torch.int64, device=xyz.device)
        for centre in torch.tensor(self.cameras, dtype=xyz.dtype, device=xyz.device):
            total += level <= whole(self.asked(xyz, level, centre), self.rule, self.count)
        return total.double() / len(self.cameras)

    def wanted(self, xyz: Tensor, level: Tensor) -> Tensor:
        """Return a mask [n] of the anchors to keep: those selected by a share above the threshold,
        or by all cameras."""
        share = self.share(xyz, level)
        return (share > self.threshold) | (share >= 1)

    def meta(self) -> dict[str, Any]:
        """Return plain values for a checkpoint."""
        return asdict(self)

    @classmethod
    def from_meta(cls, meta: dict[str, Any]) -> Levels:
        x, y, z = meta["origin"]
        return cls(**{**meta, "origin": (x, y, z), "cameras": tuple(tuple(c) for c in meta["cameras"])})


def whole(asked: Tensor, rule: LevelRule, top: int) -> Tensor:
    """Round real-valued levels of detail [n] to the finest level in use [n] int64, among levels 0
    .. top - 1.

    `blend` uses one more level than `floor`: the finest level, which fades in.
    """
    if rule == "blend":
        return blend_levels(asked, top).floor().long()
    rounded = {"round": torch.round, "floor": torch.floor, "ceil": torch.ceil}[rule](asked)
    return rounded.clamp(0, top - 1).long()


def blend_levels(asked: Tensor, top: int) -> Tensor:
    """Return level + 1 [n], clamped to [0.9999, top - 0.0001]. Its floor is the finest level, its
    fraction that level's weight."""
    return (asked + 1).clamp(0.9999, top - 1 + 0.9999)


def distances(points: Tensor, cameras: Sequence[Camera], ratio: float) -> tuple[float, float]:
    """Return quantiles (far, near) of the camera distances of points [P, 3]; 1 - `ratio` of views
    and points lie beyond each."""
    xyz, found = points.unique(dim=0).double(), []
    for camera in cameras:
        d = (xyz - camera.position.to(xyz)).norm(dim=1).numpy()
        found += [np.quantile(d, ratio), np.quantile(d, 1 - ratio)]
    return float(np.quantile(found, ratio)), float(np.quantile(found, 1 - ratio))


def centres(cameras: Sequence[Camera]) -> tuple[tuple[float, float, float], ...]:
    """Return the camera centres as plain numbers."""
    found = [camera.position.tolist() for camera in cameras]
    return tuple((x, y, z) for x, y, z in found)


def level_count(far: float, near: float, fork: int) -> int:
    """Return the number of levels between two distances: round(log_fork(far / near)) + 1."""
    return max(1, round(math.log(far / near, fork)) + 1) if near > 0 else 1


def cube(points: Tensor, extend: float) -> tuple[float, float]:
    """Return (low corner, edge) of the bounding cube of points [P, 3], scaled by `extend` about its
    centre. The values hold for all axes."""
    low, high = float(points.min()), float(points.max())
    edge = extend * max(high - low, 1e-9)
    return 0.5 * (low + high - edge), edge


def within_reach(count: int, edge: float, cube_edge: float, fork: int) -> int:
    """Return `count`, reduced until the cell indices of the finest level fit."""
    most = count
    while most > 1 and cube_edge / (edge / fork ** (most - 1)) >= MOST_CELLS:
        most -= 1
    if most < count:
        log.warning("%d levels of detail instead of %d: finer cells than that cannot be told apart", most, count)
    return most


def occupied(levels: Levels, points: Tensor) -> tuple[Tensor, Tensor]:
    """Return the cells [n, 3] and levels [n] of the occupied cells of all levels, coarse to
    fine."""
    per_level = [find_unique_cells(levels.cells(points, level))[0] for level in range(levels.count)]
    level = torch.cat([torch.full((len(cells),), i) for i, cells in enumerate(per_level)])
    return torch.cat(per_level), level
