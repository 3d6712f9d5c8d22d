"""Keypoints from a map of scores (Zhao et al., "ALIKE: accurate and lightweight keypoint detection
and descriptor extraction", IEEE Transactions on Multimedia 2022)."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn import functional

RADIUS = 2  # px; no other keypoint is nearer
TEMPERATURE = 0.1  # of the mean position around a maximum
ROUNDS = 2  # in which maxima next to suppressed pixels are found


def find_maxima(scores: Tensor) -> Tensor:
    """Return which pixels of `scores` [H, W] are the largest within RADIUS: [H, W] of bool. Pixels
    that are larger than all but suppressed ones around them count too."""
    largest = lambda x: functional.max_pool2d(x[None, None], 2 * RADIUS + 1, 1, RADIUS)[0, 0]  # noqa: E731
    found = scores == largest(scores)
    for _ in range(ROUNDS):
        near = largest(found.float()) > 0
        left = torch.where(near, torch.zeros_like(scores), scores)
        found |= (left == largest(left)) & ~near
    return found


def find_keypoints(scores: Tensor, most: int, least_score: float) -> tuple[Tensor, Tensor]:
    """Return places (x, y) [N, 2] in pixels, 0 at the centre of the first one, and scores [N], the
    largest first: those maxima of `scores` [H, W] above `least_score`, `most` at most.

    The place is the mean of the 5 x 5 pixels p around the maximum, weighted by
    exp(score(p) / TEMPERATURE).
    """
    kept = torch.where(find_maxima(scores), scores, torch.zeros_like(scores))
    for edge in (kept[:RADIUS], kept[-RADIUS:], kept[:, :RADIUS], kept[:, -RADIUS:]):
        edge.zero_()
    order = torch.sort(kept.flatten(), descending=True, stable=True)
    index = order.indices[: min(most, int((order.values > least_score).sum()))]
    rows, columns = index // scores.shape[1], index % scores.shape[1]
    step = torch.arange(-RADIUS, RADIUS + 1)
    around = scores[rows[:, None, None] + step[:, None], columns[:, None, None] + step]  # [N, 5, 5]
    share = (around.flatten(1) / TEMPERATURE).softmax(dim=1).unflatten(1, around.shape[1:])
    x, y = columns + (share.sum(1) * step).sum(1), rows + (share.sum(2) * step).sum(1)
    return torch.stack([x, y], dim=1), scores.flatten()[index]
