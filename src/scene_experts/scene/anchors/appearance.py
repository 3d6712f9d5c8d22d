"""Appearance codes: one learned vector per training view, for captures whose light or camera
settings change.

The colour network receives the code. All anchors of a view share it, so it acts as a bias of the
network's first layer. `fold` adds it to that bias, so kernels without support for codes decode
these scenes too.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Self

import torch
from torch import Tensor, nn

from scene_experts.core.types import Camera, Mode
from scene_experts.scene.anchors.mlp import HeadWeights


class Codes(nn.Module):
    """One code per training view, initialized from a standard normal distribution (Scaffold-GS).

    views: the training cameras' ids. Any other camera has the mean of all codes. `fitted` holds
    codes of other cameras, by id, that an evaluation found; they are no part of the scene.
    """

    views: tuple[int, ...]
    row: dict[int, int]
    table: nn.Parameter

    def __init__(self, dim: int, views: Sequence[int]) -> None:
        super().__init__()
        self.views = tuple(views)
        self.row = {view: i for i, view in enumerate(self.views)}
        self.table = nn.Parameter(torch.randn(len(self.views), dim))
        self.fitted: dict[int, Tensor] = {}

    def _apply(self, fn: Callable[[Tensor], Tensor], recurse: bool = True) -> Self:
        super()._apply(fn, recurse)
        self.fitted = {view: fn(code) for view, code in self.fitted.items()}
        return self

    def forward(self, camera: Camera, mode: Mode = Mode.DRAW) -> Tensor:
        """Return the code [dim] of a camera. Fitted codes are used only for drawing."""
        if mode is Mode.DRAW and camera.id in self.fitted:
            return self.fitted[camera.id]
        row = self.row.get(camera.id)
        return self.table.mean(dim=0) if row is None else self.table[row]


def fold(weights: HeadWeights, code: Tensor) -> HeadWeights:
    """Fold the code [dim], the last inputs of w1, into the first bias: w1 [x, code] + b1 = w1' x +
    b1'."""
    D = weights.w1.shape[2] - len(code)
    return replace(weights, w1=weights.w1[:, :, :D], b1=weights.b1 + weights.w1[:, :, D:] @ code)
