"""How flat a point cloud is around each point, and points put between those of flat regions (Ververas et al., SAGS, ECCV 2024).

Structure from motion finds few points on plain surfaces; midpoints between neighbours fill them, most where the surface is flattest.
"""

from __future__ import annotations

import torch
from torch import Tensor

from scene_experts.geometry.neighbours import nearest

_CHUNK = 1 << 16  # neighbourhoods decomposed at a time, bounds the memory


def curvature(points: Tensor, k: int = 10) -> Tensor:
    """Smallest singular value over the sum of the three, of each point's centred neighbourhood; [P] float64 in [0, 1/3].

    points [P, 3]; the neighbourhood is the point and its k - 1 nearest others. 0 is a plane (or a line, or one place).
    """
    xyz = points.detach().to(torch.float64)
    _, index = nearest(xyz, k - 1)
    index = torch.cat([torch.arange(len(xyz), device=xyz.device)[:, None], index], dim=1)
    out = xyz.new_zeros(len(xyz))
    for part in torch.arange(len(xyz), device=xyz.device).split(_CHUNK):
        around = xyz[index[part]]
        values = torch.linalg.svdvals(around - around.mean(1, keepdim=True))  # [c, min(k, 3)], largest first
        if values.shape[1] == 3:
            out[part] = values[:, 2] / values.sum(1).clamp_min(torch.finfo(xyz.dtype).tiny)
    return out


def flatter(curvatures: Tensor, sigmas: float = 1.0) -> Tensor:
    """Which points [P] bool have a curvature more than `sigmas` standard deviations below the mean; none where all are equal."""
    if len(curvatures) < 2:
        return torch.zeros_like(curvatures, dtype=torch.bool)
    return curvatures - curvatures.mean() < -sigmas * curvatures.std()


def pairs_to_halve(points: Tensor, flat: Tensor, low: int, high: int) -> Tensor:
    """Unordered pairs [M, 2] int64 (first <= second) of points [P, 3] whose midpoints make the denser cloud; each pair once.

    Every point with itself; a `flat` one [P] with its `low` nearest, itself among them; any other with its `high` nearest others.
    """
    n = len(points)
    _, index = nearest(points, max(low - 1, high))
    rank = torch.arange(index.shape[1], device=points.device)
    wanted = rank < torch.where(flat, low - 1, high)[:, None]  # [P, k]
    me, place = wanted.nonzero().unbind(1)
    other, every = index[me, place], torch.arange(n, device=points.device)
    keys = torch.unique(torch.cat([every * n + every, torch.minimum(me, other) * n + torch.maximum(me, other)]))
    return torch.stack([torch.div(keys, n, rounding_mode="floor"), keys % n], dim=1)
