"""Curvature of a point cloud, and midpoints that make its flat regions denser (Ververas et al.,
SAGS, ECCV 2024).

Structure from motion finds few points on untextured surfaces. Midpoints between neighbours fill
them, most densely in flat regions.
"""

from __future__ import annotations

import torch
from torch import Tensor

from scene_experts.geometry.neighbours import find_neighbours

_CHUNK = 1 << 16  # neighbourhoods decomposed at a time, which limits the memory


def curvature(points: Tensor, k: int = 10) -> Tensor:
    """Curvature [P] float64 in [0, 1/3] of points [P, 3]: smallest singular value of the centred
    neighbourhood / sum of all three.

    A neighbourhood is a point and its k - 1 nearest neighbours. The curvature of a plane, a line or
    coincident points is 0.
    """
    xyz = points.detach().to(torch.float64)
    _, index = find_neighbours(xyz, k - 1)
    index = torch.cat([torch.arange(len(xyz), device=xyz.device)[:, None], index], dim=1)
    out = xyz.new_zeros(len(xyz))
    for part in torch.arange(len(xyz), device=xyz.device).split(_CHUNK):
        around = xyz[index[part]]
        values = torch.linalg.svdvals(around - around.mean(1, keepdim=True))  # [c, min(k, 3)], largest first
        if values.shape[1] == 3:
            out[part] = values[:, 2] / values.sum(1).clamp_min(torch.finfo(xyz.dtype).tiny)
    return out


def find_flat(curvatures: Tensor, sigmas: float = 1.0) -> Tensor:
    """Mask [P] bool of the points whose curvature is more than `sigmas` standard deviations below
    the mean."""
    if len(curvatures) < 2:
        return torch.zeros_like(curvatures, dtype=torch.bool)
    return curvatures - curvatures.mean() < -sigmas * curvatures.std()


def find_midpoint_pairs(points: Tensor, flat: Tensor, low: int, high: int) -> Tensor:
    """Unordered pairs [M, 2] int64 (first <= second) of points [P, 3] whose midpoints are the
    denser cloud; each pair once.

    Each point pairs with itself. A point in `flat` [P] also pairs with its `low` - 1 nearest
    neighbours, any other point with its `high` nearest neighbours.
    """
    n = len(points)
    _, index = find_neighbours(points, max(low - 1, high))
    rank = torch.arange(index.shape[1], device=points.device)
    wanted = rank < torch.where(flat, low - 1, high)[:, None]  # [P, k]
    me, place = wanted.nonzero().unbind(1)
    other, every = index[me, place], torch.arange(n, device=points.device)
    keys = torch.unique(torch.cat([every * n + every, torch.minimum(me, other) * n + torch.maximum(me, other)]))
    return torch.stack([torch.div(keys, n, rounding_mode="floor"), keys % n], dim=1)
