"""Exact nearest neighbours, for the initial sizes of anchors and Gaussians and for graphs over
points."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from scene_experts.native import library as native

_CHUNK = 1 << 16  # points whose neighbours are sorted at a time, which limits the memory


def find_neighbours(points: Tensor, k: int) -> tuple[Tensor, Tensor]:
    """Squared distances [P, k'] (ascending) and indices [P, k'] of the k' = min(k, P - 1) nearest
    neighbours of `points` [P, 3].

    A neighbour is a point with another index, so a duplicate is a neighbour at distance 0.
    Distances are float64, exact to rounding. Equally near neighbours are in the order of their
    indices; which of them are the last of a list is not defined, but always the same. Raises
    ValueError for positions that are not finite.
    """
    n = points.shape[0]
    k = max(0, min(k, n - 1))
    d2 = torch.empty((n, k), dtype=torch.float64)
    index = torch.empty((n, k), dtype=torch.int64)
    if k:
        xyz = points.detach().cpu().double()
        near, place = _find_near(xyz.numpy(), k)
        for rows in torch.arange(n).split(_CHUNK):
            found = near[place[rows]].sort(dim=1).values
            gap = (xyz[found] - xyz[rows, None]).square()
            gap = (gap[..., 0] + gap[..., 1] + gap[..., 2]).masked_fill((found < 0) | (found == rows[:, None]), torch.inf)
            gap, by = gap.sort(dim=1, stable=True)
            d2[rows], index[rows] = gap[:, :k], found.gather(1, by)[:, :k]
    return d2.to(points.device), index.to(points.device)


def knn_d2(points: Tensor) -> Tensor:
    """Mean squared distance [P] float64 to the 3 nearest neighbours of points [P, 3], in squared
    world units.

    With 2 or 3 points the mean is over the neighbours that exist; a single point gives 0.
    Coincident points give 0 too, so callers clamp the result (3DGS and Scaffold-GS: to at least
    1e-7) before the logarithm.
    """
    d2, _ = find_neighbours(points, 3)
    return d2.mean(1) if d2.shape[1] else d2.new_zeros(points.shape[0])


def median_neighbour_distance(points: Tensor) -> float:
    """Median distance to the nearest neighbour in world units; 0 for fewer than 2 points."""
    d2, _ = find_neighbours(points, 1)
    return float(d2.median().sqrt()) if d2.numel() else 0.0


def _find_near(xyz: np.ndarray, k: int) -> tuple[Tensor, Tensor]:
    """For each place with points, at least k + 1 points that no other is nearer than, [places, m]
    (-1: none); and the place of each point.

    The tree has each place once: duplicates would all be in one leaf of it. The number of threads
    does not change the result.
    """
    from scipy.spatial import KDTree  # takes 0.3 s, and most commands do not need it

    places, place, count = np.unique(xyz, axis=0, return_inverse=True, return_counts=True)
    near = KDTree(places).query(places, min(k + 1, len(places)), workers=native.count_threads())[1].reshape(len(places), -1)
    rank = np.arange(min(k + 1, count.max()))
    start = (count.cumsum() - count)[:, None]
    here = np.where(rank < count[:, None], np.argsort(place, kind="stable")[np.minimum(start + rank, len(xyz) - 1)], -1)
    return torch.from_numpy(here[near].reshape(len(places), -1)), torch.from_numpy(place)
