"""Bits of whole numbers under a logistic distribution, and their derivatives."""

from __future__ import annotations

import math
from typing import Any

import torch
from torch import Tensor

FLOOR = 1e-5  # probability that every number has at least
_INSIDE = 1 - 20 * FLOOR


def logistic_bits(away: Tensor, log_spread: Tensor) -> Tensor:
    """Return the bits of the bin of width 1 around `away` under a logistic distribution around 0:
    -log2((1 - 20 e) (sigma((away + 1/2) / s) - sigma((away - 1/2) / s)) + e), s = e^log_spread, e =
    FLOOR. Of one shape."""
    return _LogisticBits.apply(away, log_spread)  # type: ignore[no-any-return]


def find_slopes(away: Tensor, log_spread: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Return the probability of the bin, and the derivatives of its bits by `away` and by
    `log_spread`. All of one shape."""
    inverse, u = torch.exp(-log_spread), away.abs().neg_()  # both sigmoids are small on this side, and their difference is exact
    upper, lower = (u + 0.5).mul_(inverse), (u - 0.5).mul_(inverse)
    a, b = upper.sigmoid(), lower.sigmoid()
    share = (a - b).mul_(_INSIDE).add_(FLOOR)
    da, db = a.addcmul_(a, a, value=-1), b.addcmul_(b, b, value=-1)  # a (1 - a)
    factor = (-_INSIDE / math.log(2)) / share
    by_spread = lower.mul_(db).sub_(upper.mul_(da)).mul_(factor)
    by_away = db.sub_(da).mul_(inverse).mul_(factor).mul_(away.sign())
    return share, by_away, by_spread


class _LogisticBits(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, away: Tensor, log_spread: Tensor) -> Tensor:
        share, by_away, by_spread = find_slopes(away, log_spread)
        ctx.save_for_backward(by_away, by_spread)
        return -share.log2()

    @staticmethod
    def backward(ctx: Any, *upstream: Tensor) -> tuple:
        by_away, by_spread = ctx.saved_tensors
        return upstream[0] * by_away, upstream[0] * by_spread
