"""Slopes that training passes between its parts where it does without autograd.

A part then returns its result with a function that pulls slopes back through it: it takes the
slopes of the loss in the result, and returns those in its inputs, or adds them to the parameters.
"""

from __future__ import annotations

from collections.abc import Callable
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


PullPicture = Callable[[Tensor], GaussianSlopes]
"""Takes the slopes of a picture [H, W, 3]."""
PullScene = Callable[[GaussianSlopes, Regularisers], None]
"""Adds the slopes of the parameters, with those of the regularisers, to their `grad`."""
