"""Codebooks and palettes for packed files: 256 levels for many scalars, and up to 65,536
representatives of many vectors; deterministic.

Plain k-means with 65,536 centres compares every vector with every centre. Here the vectors are
first split into a few hundred coarse groups, each of which then gets its share of the centres, by
its size and spread, and finds them alone: the work falls by two orders.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from scene_experts.files.formats.pack import Bytes, Floats

LEVELS = 256
_SAMPLE = 1 << 18  # values that a codebook is fitted to
_GROUP = 512  # vectors of a coarse group, about
_BLOCK = 4096


def codebook(values: NDArray[Any], steps: int = 24) -> Floats:
    """256 sorted levels for scalars of any shape, by Lloyd's iteration from even ranks and even
    steps; exact for few values."""
    flat = np.sort(np.asarray(values, np.float64).ravel())
    if not len(flat):
        return np.zeros(LEVELS)
    if len(flat) > _SAMPLE:
        flat = flat[np.linspace(0, len(flat) - 1, _SAMPLE).round().astype(np.int64)]
    distinct = np.unique(flat)
    if len(distinct) <= LEVELS:
        return np.concatenate([distinct, np.full(LEVELS - len(distinct), distinct[-1])])
    ranks = flat[np.linspace(0, len(flat) - 1, LEVELS // 2).round().astype(np.int64)]
    level = np.sort(np.concatenate([ranks, np.linspace(flat[0], flat[-1], LEVELS - LEVELS // 2)]))
    total = np.concatenate([[0.0], np.cumsum(flat)])
    for _ in range(steps):
        edge = np.concatenate([[0], np.searchsorted(flat, (level[1:] + level[:-1]) / 2), [len(flat)]])
        count = np.diff(edge)
        level = np.where(count > 0, np.diff(total[edge]) / np.maximum(count, 1), level)
    return np.sort(level)


def nearest_levels(values: NDArray[Any], level: Floats) -> Bytes:
    """The index of the nearest level for each value, in its shape."""
    return np.searchsorted((level[1:] + level[:-1]) / 2, np.asarray(values, np.float64)).astype(np.uint8)


def palette(vectors: Tensor, size: int, steps: int = 8) -> tuple[Tensor, Tensor]:
    """At most `size` representatives [P, C] of vectors [N, C] float32, and the index [N] int64 of
    each vector's own."""
    n = len(vectors)
    if n <= size:
        return vectors, torch.arange(n)
    groups = max(1, min(1024, n // _GROUP))
    coarse = _spread_start(vectors, groups)
    coarse, group = _lloyd(vectors, coarse, steps)
    order = group.argsort(stable=True)
    counts = torch.bincount(group, minlength=len(coarse))
    share = _shares(vectors, coarse, group, counts, size)
    centres, label = [], torch.empty(n, dtype=torch.int64)
    first = 0
    for rows, k in zip(order.split(counts.tolist()), share.tolist()):
        if not len(rows):
            continue
        found, own = _lloyd(vectors[rows], _spread_start(vectors[rows], k), steps)
        centres.append(found)
        label[rows] = own + first
        first += len(found)
    return torch.cat(centres), label


def _shares(vectors: Tensor, coarse: Tensor, group: Tensor, counts: Tensor, size: int) -> Tensor:
    """How many centres each group gets: by the square root of its size times its spread, 1 at
    least, its size at most."""
    error = ((vectors - coarse[group]) ** 2).sum(1).double()
    spread = torch.zeros(len(coarse), dtype=torch.float64).index_add_(0, group, error)
    weight = (spread * counts).sqrt().clamp_min(1e-12)
    share, cap = torch.ones_like(counts), counts.clamp_min(1)
    for _ in range(8):
        left = size - int(share.sum())
        free = torch.where(share < cap, weight, 0.0)
        if left <= 0 or not bool(free.any()):
            break
        share = torch.minimum(cap, share + (left * free / free.sum()).floor().long())
    return share


def _spread_start(vectors: Tensor, k: int) -> Tensor:
    """k of the vectors, evenly along their direction of greatest spread."""
    k = min(k, len(vectors))
    centred = vectors - vectors.mean(0)
    direction = torch.ones(vectors.shape[1]) / math.sqrt(vectors.shape[1])
    for _ in range(6):  # power iteration
        direction = centred.T @ (centred @ direction)
        direction = direction / direction.norm().clamp_min(1e-20)
    order = (centred @ direction).argsort(stable=True)
    return vectors[order[torch.linspace(0, len(order) - 1, k).round().long()]]


def _lloyd(vectors: Tensor, centres: Tensor, steps: int) -> tuple[Tensor, Tensor]:
    """Centres after some steps of k-means, and each vector's nearest. Centres that lose all vectors
    stay where they are."""
    label = torch.zeros(len(vectors), dtype=torch.int64)
    for _ in range(steps if len(centres) < len(vectors) else 0):
        label = _nearest(vectors, centres)
        count = torch.bincount(label, minlength=len(centres))
        mean = torch.zeros_like(centres).index_add_(0, label, vectors) / count.clamp_min(1)[:, None]
        centres = torch.where(count[:, None] > 0, mean, centres)
    return centres, _nearest(vectors, centres)


def _nearest(vectors: Tensor, centres: Tensor) -> Tensor:
    half = (centres * centres).sum(1) / 2
    parts = [torch.addmm(half, block, centres.T, alpha=-1).argmin(1) for block in vectors.split(_BLOCK)]
    return torch.cat(parts) if parts else torch.zeros(0, dtype=torch.int64)
