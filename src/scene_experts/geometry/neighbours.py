"""Exact nearest neighbours in torch, for the initial sizes of anchors and Gaussians and for graphs over points.

Points are split at medians into leaves of equal size. Each leaf then visits the other leaves in the order of the distance between their
boxes, and stops when no box is nearer than the worst neighbour of any of its points. Whole branches of the tree are skipped first. Every
step processes many leaves at once.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

_LEAF = 64  # points in a leaf, 64 to 128; smaller leaves need fewer distances but more boxes (24 is twice as slow at 200k points)
_PAIRS = 1 << 22  # distances computed at a time, which limits the memory
_BRANCHES = 32  # estimated number of branches that a leaf visits


class _Leaves(NamedTuple):
    xyz: Tensor  # [3, L, S] float64
    names: Tensor  # [L, S] index of each entry's point
    real: Tensor  # [L, S] bool; the other entries repeat points to fill the leaves


def find_neighbours(points: Tensor, k: int) -> tuple[Tensor, Tensor]:
    """Squared distances [P, k'] (ascending) and indices [P, k'] of the k' = min(k, P - 1) nearest neighbours of `points` [P, 3].

    A neighbour is a point with another index, so a duplicate is a neighbour at distance 0. Distances are float64, exact to rounding.
    """
    n = points.shape[0]
    k = max(0, min(k, n - 1))
    if k == 0:
        return points.new_zeros((n, 0), dtype=torch.float64), torch.zeros((n, 0), dtype=torch.int64, device=points.device)
    xyz = points.detach().to(torch.float64)
    leaves, real = _split(xyz, max(_LEAF, k + 1))  # one leaf has enough points for a list
    best, ids = _search(_Leaves(xyz[leaves].permute(2, 0, 1).contiguous(), leaves, real), k)
    d2, index = best.new_empty((n, k)), ids.new_empty((n, k))
    d2[leaves[real]], index[leaves[real]] = best[real], ids[real]
    return d2, index


def knn_d2(points: Tensor) -> Tensor:
    """Mean squared distance [P] float64 to the 3 nearest neighbours of points [P, 3], in squared world units.

    With 2 or 3 points the mean is over the neighbours that exist; a single point gives 0. Coincident points give 0 too, so callers clamp
    the result (3DGS and Scaffold-GS: to at least 1e-7) before the logarithm.
    """
    d2, _ = find_neighbours(points, 3)
    return d2.mean(1) if d2.shape[1] else d2.new_zeros(points.shape[0])


def median_neighbour_distance(points: Tensor) -> float:
    """Median distance to the nearest neighbour in world units; 0 for fewer than 2 points."""
    d2, _ = find_neighbours(points, 1)
    return float(d2.median().sqrt()) if d2.numel() else 0.0


def _split(xyz: Tensor, size: int) -> tuple[Tensor, Tensor]:
    """Indices [L, S] of leaves of equal size, and which entries are real; the others repeat points to fill the leaves."""
    n = xyz.shape[0]
    levels = max(0, math.floor(math.log2(max(1.0, n / size))))
    count = 1 << levels
    each = -(-n // count)
    fill = count * each - n
    extra = torch.arange(fill, device=xyz.device) * n // max(fill, 1)  # spread evenly, so that no leaf consists of repeats
    order = torch.cat([torch.arange(n, device=xyz.device), extra]).view(1, -1)
    real = (torch.arange(n + fill, device=xyz.device) < n).view(1, -1)
    for _ in range(levels):
        coords = xyz[order]  # [G, S, 3]
        axis = (coords.amax(1) - coords.amin(1)).argmax(1)  # the longest side of each group
        key = coords.gather(2, axis.view(-1, 1, 1).expand(-1, coords.shape[1], 1)).squeeze(2)
        by = key.argsort(dim=1, stable=True)  # stable: points on a lattice share coordinates, and the split must not depend on the machine
        half = (2 * order.shape[0], order.shape[1] // 2)
        order, real = order.gather(1, by).view(half), real.gather(1, by).view(half)
    return order, real


def _search(tree: _Leaves, k: int) -> tuple[Tensor, Tensor]:
    """Squared distances and indices [L, S, k] of the k nearest neighbours of every leaf entry."""
    count, size = tree.names.shape
    best = tree.xyz.new_full((count, size, k), math.inf)
    ids = torch.full((count, size, k), -1, dtype=torch.int64, device=best.device)
    low, high = tree.xyz.amin(2), tree.xyz.amax(2)  # [3, L]
    group = 1 << max(0, count.bit_length() // 2 - 2)  # leaves per branch of the tree: a quarter of sqrt(L)
    branch_low, branch_high = low.view(3, -1, group).amin(2), high.view(3, -1, group).amax(2)
    chunk = min(512, max(1, _PAIRS // (count // group + _BRANCHES * group)))
    for start in range(0, count, chunk):
        own = torch.arange(start, min(start + chunk, count), device=best.device)
        _meet(tree, own, own, best, ids)
        worst = best[own, :, -1].masked_fill(~tree.real[own], -math.inf).amax(1)
        far = _box_gap(low[:, own, None], high[:, own, None], branch_low[:, None], branch_high[:, None])  # [c, L / group]
        mine, branch = torch.where(far < worst[:, None])
        mine = mine.repeat_interleave(group)
        other = (branch[:, None] * group + torch.arange(group, device=best.device)).view(-1)
        gap = _box_gap(low[:, own[mine]], high[:, own[mine]], low[:, other], high[:, other])
        near = ((gap < worst[mine]) & (own[mine] != other)).nonzero().squeeze(1)
        mine, other, gap = mine[near], other[near], gap[near]
        by = gap.argsort(stable=True)
        by = by[mine[by].argsort(stable=True)]  # the other leaves of each leaf from near to far
        mine, other = mine[by], other[by]
        met = torch.bincount(mine, minlength=len(own))
        rank = torch.arange(len(mine), device=best.device) - (met.cumsum(0) - met)[mine]
        by = rank.argsort(stable=True)
        for pairs in by.split(torch.bincount(rank).tolist()):  # a leaf occurs at most once per round
            _meet(tree, own[mine[pairs]], other[pairs], best, ids)
    return best, ids


def _box_gap(low: Tensor, high: Tensor, low_other: Tensor, high_other: Tensor) -> Tensor:
    """Squared distances between boxes with corners [3, ...], axis by axis."""
    total = torch.zeros(())
    for axis in range(3):
        gap = torch.maximum(low_other[axis] - high[axis], low[axis] - high_other[axis]).clamp_min_(0)
        total = gap.square_() if axis == 0 else total.add_(gap.square_())
    return total


def _meet(tree: _Leaves, mine: Tensor, other: Tensor, best: Tensor, ids: Tensor) -> None:
    """Merge the points of leaf other[i] into the lists of leaf mine[i]; changes `best` and `ids`."""
    k = best.shape[2]
    theirs = tree.xyz[:, other]  # [3, c, S]
    points = tree.xyz[:, mine]
    gap = _box_gap(points, points, theirs.amin(2, keepdim=True), theirs.amax(2, keepdim=True))  # [c, S]
    pair, entry = torch.where((gap < best[mine, :, -1]) & tree.real[mine])  # most points are too far from the other box
    step = max(1, _PAIRS // tree.names.shape[1])
    for a, e in zip(pair.split(step), entry.split(step), strict=True):
        row = mine[a]
        query, offered = points[:, a, e], theirs[:, a]  # [3, Q], [3, Q, S]
        d2 = (offered[0] - query[0, :, None]).square_()
        for axis in (1, 2):
            d2 += (offered[axis] - query[axis, :, None]).square_()
        names = tree.names[other[a]]
        d2.masked_fill_(~tree.real[other[a]] | (names == tree.names[row, e][:, None]), math.inf)
        pool = torch.cat([best[row, e], d2], dim=1)
        best[row, e], pick = pool.topk(k, dim=1, largest=False, sorted=True)
        ids[row, e] = torch.cat([ids[row, e], names], dim=1).gather(1, pick)
