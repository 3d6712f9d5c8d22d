"""Slopes that training passes between its parts where it does without autograd.

A part then returns its result with a function that pulls slopes back through it: it takes the
slopes of the loss in the result, and returns those in its inputs, or adds them to the parameters.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from torch import Tensor


@dataclass(frozen=True)
class GaussianSlopes:
    """Slopes of the loss in M Gaussians, contiguous tensors."""

    means: Tensor  # [M, 3]
    quats: Tensor  # [M, 4]
    scales: Tensor  # [M, 3]
    opacities: Tensor  # [M]
    colors: Tensor  # [M, 3]


@dataclass(frozen=True)
class Regularisers:
    """Weights of the terms of the loss that see the decoded scene and not the picture; 0 where a
    term is off. The terms are those of `training.losses`."""

    volume: float = 0.0
    hinge: float = 0.0
    tau: float = 0.0
    load: float = 0.0
    mean_opacity: float = 0.0
    mean_size: float = 0.0


def allocate(like: Tensor, shapes: Sequence[tuple[int, ...]]) -> tuple[Tensor, list[Tensor]]:
    """Return an array of zeros, with the dtype and device of `like`, and views of it with these
    shapes, which begin at multiples of 64 bytes: Triton compiles anew for other addresses."""
    counts = [math.prod(shape) for shape in shapes]
    whole = like.new_zeros(sum(-(-count // APART) * APART for count in counts))
    at, views = 0, []
    for shape, count in zip(shapes, counts):
        views.append(whole[at : at + count].view(shape))
        at += -(-count // APART) * APART
    return whole, views


APART = 16  # values of 4 bytes
PullPicture = Callable[[Tensor], GaussianSlopes]
"""Takes the slopes of a picture [H, W, 3]."""
PullScene = Callable[[GaussianSlopes, Regularisers], None]
"""Adds the slopes of the parameters, with those of the regularisers, to their `grad`."""
