"""Appearance codes: a learned vector per training view that the colour network sees, for captures whose light or camera settings change.

A code is the same for every anchor of a view, so for the first layer of the colour network it is only another bias: `fold` puts it there,
and kernels that know nothing of codes decode such scenes too.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Literal, Self

import torch
from torch import Tensor, nn

from scene_experts.core.types import Camera, Mode
from scene_experts.scene.anchors.mlp import HeadWeights

TestRule = Literal["mean", "index"]


class Codes(nn.Module):
    """One code per training view, standard normal at the start (Scaffold-GS).

    views: the training cameras' ids. rule: the code of any other camera: the mean of all codes, or (what Scaffold-GS does) that of the
    training view with the test view's number among the test views. `fitted` holds codes of other cameras, by id, that an evaluation
    found; they are no part of the scene.
    """

    views: tuple[int, ...]
    row: dict[int, int]
    table: nn.Parameter

    def __init__(self, dim: int, views: Sequence[int], rule: TestRule = "mean") -> None:
        super().__init__()
        self.views, self.rule = tuple(views), rule
        self.row = {view: i for i, view in enumerate(self.views)}
        self.table = nn.Parameter(torch.randn(len(self.views), dim))
        self.fitted: dict[int, Tensor] = {}

    def _apply(self, fn: Callable[[Tensor], Tensor], recurse: bool = True) -> Self:
        super()._apply(fn, recurse)
        self.fitted = {view: fn(code) for view, code in self.fitted.items()}
        return self

    def forward(self, camera: Camera, mode: Mode = Mode.DRAW) -> Tensor:
        """The code [dim] of a camera. Fitted codes are for drawing only."""
        if mode is Mode.DRAW and camera.id in self.fitted:
            return self.fitted[camera.id]
        row = self.row.get(camera.id)
        if row is None and self.rule == "index" and camera.id >= 0:  # below 0: a free camera, at no view's place
            row = (camera.id - sum(view < camera.id for view in self.views)) % len(self.views)  # its number among the other views
        return self.table.mean(dim=0) if row is None else self.table[row]


def fold(weights: HeadWeights, code: Tensor) -> HeadWeights:
    """The same head for inputs without the code [dim], which are w1's last columns: w1 [x, code] + b1 = w1' x + b1'."""
    D = weights.w1.shape[2] - len(code)
    return replace(weights, w1=weights.w1[:, :, :D], b1=weights.b1 + weights.w1[:, :, D:] @ code)
