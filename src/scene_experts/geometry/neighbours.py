"""Exact nearest neighbours without a tree library: initial sizes of anchors and Gaussians, and graphs over points.

Points are split at medians into equal leaves. Each leaf then meets the other leaves in the order of the distance between boxes, and stops
when no box is nearer than the worst neighbour any of its points has. Every step works on all leaves at once.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

_LEAF = 24  # points in a leaf, about; small leaves mean fewer distances but more boxes
_PAIRS = 1 << 22  # distances held at a time, bounds the memory


def nearest(points: Tensor, k: int) -> tuple[Tensor, Tensor]:
    """Squared distances [P, k'] (ascending) and indices [P, k'] of the k' = min(k, P - 1) nearest other points of each of `points` [P, 3].

    "Other" means another index: an exact duplicate counts, with distance 0. Distances are float64 and exact to rounding.
    """
    n = points.shape[0]
    k = max(0, min(k, n - 1))
    if k == 0:
        return points.new_zeros((n, 0), dtype=torch.float64), torch.zeros((n, 0), dtype=torch.int64, device=points.device)
    xyz = points.detach().to(torch.float64)
    leaves, real = _split(xyz, _leaf_size(k))
    boxes = xyz[leaves]  # [L, S, 3]
    low, high = boxes.amin(1), boxes.amax(1)
    best, ids = _search(xyz, leaves, real, low, high, k)
    d2, index = best.new_empty((n, k)), ids.new_empty((n, k))
    d2[leaves[real]], index[leaves[real]] = best[real], ids[real]
    return d2, index


def knn_d2(points: Tensor) -> Tensor:
    """Mean squared distance [P] to the 3 nearest other points, float64, squared world units.

    With 2 or 3 points the mean is over those there are; a lone point gives 0. Coincident points give 0, so callers clamp from below
    (3DGS and Scaffold-GS: at 1e-7) before the logarithm.
    """
    d2, _ = nearest(points, 3)
    return d2.mean(1) if d2.shape[1] else d2.new_zeros(points.shape[0])


def median_neighbour_distance(points: Tensor) -> float:
    """Median distance to the nearest other point, world units; 0 for fewer than 2 points."""
    d2, _ = nearest(points, 1)
    return float(d2.median().sqrt()) if d2.numel() else 0.0


def _leaf_size(k: int) -> int:
    return max(_LEAF, k + 1)  # so that a leaf alone can fill the list


def _split(xyz: Tensor, size: int) -> tuple[Tensor, Tensor]:
    """Indices [L, S] of equal leaves, and which entries are real: the rest repeat points to fill the leaves up."""
    n = xyz.shape[0]
    levels = max(0, math.floor(math.log2(max(1.0, n / size))))
    count = 1 << levels
    each = -(-n // count)
    fill = count * each - n
    extra = torch.arange(fill, device=xyz.device) * n // max(fill, 1)  # spread evenly, so that no leaf is all repeats
    order = torch.cat([torch.arange(n, device=xyz.device), extra]).view(1, -1)
    real = (torch.arange(n + fill, device=xyz.device) < n).view(1, -1)
    for _ in range(levels):
        coords = xyz[order]  # [G, S, 3]
        axis = (coords.amax(1) - coords.amin(1)).argmax(1)  # the longest side of each group
        key = coords.gather(2, axis.view(-1, 1, 1).expand(-1, coords.shape[1], 1)).squeeze(2)
        by = key.argsort(dim=1)
        half = (2 * order.shape[0], order.shape[1] // 2)
        order, real = order.gather(1, by).view(half), real.gather(1, by).view(half)
    return order, real


def _search(xyz: Tensor, leaves: Tensor, real: Tensor, low: Tensor, high: Tensor, k: int) -> tuple[Tensor, Tensor]:
    """The k best of every leaf entry, [L, S, k] squared distances and indices."""
    count, size = leaves.shape
    best = xyz.new_full((count, size, k), math.inf)
    ids = torch.full((count, size, k), -1, dtype=torch.int64, device=xyz.device)
    chunk = max(1, _PAIRS // count)
    for start in range(0, count, chunk):
        own = torch.arange(start, min(start + chunk, count), device=xyz.device)
        gap = (low[None] - high[own, None]).maximum(low[own, None] - high[None]).clamp_min(0)  # [c, L, 3]
        gap = gap.square().sum(-1)
        _meet(xyz, leaves, real, own, own, best, ids)
        worst = _worst(best, real, own)
        gap[torch.arange(len(own)), own] = math.inf  # met already
        # Few leaves are near enough; sort only as many as the fullest row needs.
        width = int((gap < worst[:, None]).sum(1).max())
        near, other = gap.topk(width, dim=1, largest=False) if width else (gap[:, :0], gap[:, :0].long())
        live = torch.arange(len(own), device=xyz.device)
        for rank in range(width):
            live = live[near[live, rank] < _worst(best, real, own[live])]
            if not len(live):
                break
            _meet(xyz, leaves, real, own[live], other[live, rank], best, ids)
    return best, ids


def _worst(best: Tensor, real: Tensor, rows: Tensor) -> Tensor:
    """The largest k-th distance among a leaf's real points, [rows]."""
    return best[rows, :, -1].masked_fill(~real[rows], -math.inf).amax(1)


def _meet(xyz: Tensor, leaves: Tensor, real: Tensor, mine: Tensor, other: Tensor, best: Tensor, ids: Tensor) -> None:
    """Offers the points of leaf other[i] to the lists of leaf mine[i]; changes `best` and `ids`."""
    size, k = leaves.shape[1], best.shape[2]
    step = max(1, _PAIRS // (size * size))
    for a, b in zip(mine.split(step), other.split(step), strict=True):
        queries, offered = leaves[a], leaves[b]  # [c, S]
        d2 = (xyz[queries][:, :, None] - xyz[offered][:, None]).square_().sum(-1)  # [c, S, S]
        d2.masked_fill_(~real[b][:, None, :] | (queries[:, :, None] == offered[:, None, :]), math.inf)
        row, entry = torch.where(d2.amin(2) < best[a, :, -1])  # few lists change once the first leaves are met
        pool = torch.cat([best[a[row], entry], d2[row, entry]], dim=1)
        names = torch.cat([ids[a[row], entry], offered[row]], dim=1)
        best[a[row], entry], pick = pool.topk(k, dim=1, largest=False, sorted=True)
        ids[a[row], entry] = names.gather(1, pick)
