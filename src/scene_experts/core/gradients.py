"""Gradients that training passes between its parts where it does without autograd.

A part then returns its result with a function that takes the gradients of the loss with respect to
the result, and returns those with respect to its inputs, or adds them to the parameters.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

from torch import Tensor, nn


@dataclass(frozen=True)
class GaussianGradients:
    """Gradients of the loss with respect to M Gaussians, contiguous tensors."""

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


class ReusedGradients:
    """Gradients that one view after the other writes into the same tensors.

    The tensors become the `grad` of their parameters. From the second view of a batch on, `grad` is
    the sum.
    """

    def __init__(self, pairs: Iterable[tuple[nn.Parameter, Tensor]]) -> None:
        self.pairs: list[tuple[nn.Parameter, Tensor]] = list(pairs)

    def release(self) -> None:
        """Copy the gradients of an earlier view of the batch, before the tensors are written."""
        for parameter, gradient in self.pairs:
            if parameter.grad is gradient:
                parameter.grad = gradient.clone()

    def add(self) -> None:
        """Add the tensors to the `grad` of the parameters."""
        for parameter, gradient in self.pairs:
            parameter.grad = gradient if parameter.grad is None else parameter.grad + gradient


APART = 16  # values of 4 bytes
BackwardPicture = Callable[[Tensor], GaussianGradients]
"""Takes the gradients of a picture [H, W, 3]."""
BackwardScene = Callable[[GaussianGradients, Regularisers], None]
"""Adds the gradients of the parameters, with those of the regularisers, to their `grad`."""
