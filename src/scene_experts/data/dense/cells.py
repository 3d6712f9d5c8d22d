"""Thins points to one in each cell, so that their spacing is even in the picture."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

FINEST, COARSEST = 1.5, 256.0  # edges of cells that are tried, in footprints
_STEPS = 12  # of the bisection, which finds the edge within 0.2 %
_BITS = 20  # of a cell's number along each axis


@dataclass(frozen=True)
class SizedPoints:
    """n points with the pictures' colours."""

    xyz: NDArray[np.float64]  # [n, 3] world
    rgb: NDArray[np.float64]  # [n, 3], 0 to 255
    size: NDArray[np.float64]  # [n], edge of the point's pixel at its depth, world units
    weight: NDArray[np.float64]  # [n], above 0

    def __len__(self) -> int:
        return len(self.xyz)

    def pick(self, chosen: NDArray[np.bool_]) -> SizedPoints:
        """Return the chosen [n] points."""
        return SizedPoints(self.xyz[chosen], self.rgb[chosen], self.size[chosen], self.weight[chosen])

    def spread(self, most: int) -> SizedPoints:
        """Return at most `most` of the points, evenly spread over their order."""
        chosen = np.zeros(len(self), dtype=np.bool_)
        chosen[np.linspace(0, len(self) - 1, min(most, len(self))).round().astype(np.int64)] = True
        return self.pick(chosen)

    @classmethod
    def of(cls, xyz: NDArray[np.float64], rgb: NDArray[np.uint8]) -> SizedPoints:
        """Return points [n, 3] without a size, of equal weight."""
        return cls(xyz, rgb.astype(np.float64), np.zeros(len(xyz)), np.ones(len(xyz)))

    @classmethod
    def join(cls, parts: list[SizedPoints]) -> SizedPoints:
        """Return the points of all parts, of which there is at least one."""
        return cls(*(np.concatenate([getattr(part, name) for part in parts]) for name in ("xyz", "rgb", "size", "weight")))


def fuse(cloud: SizedPoints, edge: float, least: int = 1) -> SizedPoints:
    """Return the weighted mean of the points of each cell that holds at least `least`.

    The edge of a point's cell is the largest power of two, in world units, that is at most `edge`
    times the point's size. Cells of another edge are other cells, even at the same place.
    """
    if len(cloud) == 0:
        return cloud
    level = np.floor(np.log2(cloud.size * edge)).astype(np.int64)
    cell = np.floor(cloud.xyz / np.exp2(level)[:, None]).astype(np.int64) & ((1 << _BITS) - 1)  # far cells may meet, which is rare
    key = ((level - level.min()) & 15) << (3 * _BITS) | cell[:, 0] << (2 * _BITS) | cell[:, 1] << _BITS | cell[:, 2]
    _, place, count = np.unique(key, return_inverse=True, return_counts=True)
    total = np.bincount(place, cloud.weight).astype(np.float64)
    mean = lambda value: np.bincount(place, cloud.weight * value) / total  # noqa: E731
    means = lambda values: np.stack([mean(values[:, i]) for i in range(values.shape[1])], 1)  # noqa: E731
    return SizedPoints(means(cloud.xyz), means(cloud.rgb), mean(cloud.size), total).pick(count >= least)


def thin(cloud: SizedPoints, wanted: int, least: int = 1) -> tuple[SizedPoints, float]:
    """Return at most `wanted` points of `fuse`, as many as possible, and the edge of their cells."""
    low, high = np.log2(FINEST), np.log2(COARSEST)
    found = fuse(cloud, COARSEST, least)
    for _ in range(_STEPS):
        middle = (low + high) / 2
        tried = fuse(cloud, float(np.exp2(middle)), least)
        if len(tried) > wanted:
            low = middle
        else:
            high, found = middle, tried
    return found, float(np.exp2(high))
