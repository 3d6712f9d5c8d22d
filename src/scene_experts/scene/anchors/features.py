"""What the decoders see of an anchor: its own feature, or a blend of what it learned at several resolutions (Scaffold-GS's feature bank).

Routers always see the raw feature, so that routing stays a property of the anchor and not of the view.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Protocol

import torch
from torch import Tensor, nn
from torch.nn import functional

from scene_experts.core.errors import InputError, expect_at_least
from scene_experts.core.parts import Part, register
from scene_experts.core.table import Table
from scene_experts.scene.anchors.mlp import linear_init


class Mixer(Protocol):
    """The features of the anchors `rows` [A] for one camera. A module: its parameters follow the rate called `mix`."""

    def __call__(self, table: Table, rows: Tensor, direction: Tensor, distance: Tensor) -> Tensor:
        """direction [A, 3] of unit length, camera to anchor; distance [A, 1] in trained world units -> [A, width]."""
        ...


@dataclass(frozen=True)
class FeatureMix(Part, ABC):
    """What the decoders see of an anchor's feature."""

    @abstractmethod
    def width(self, F: int) -> int:
        """Size of what the decoders see, for features of size F."""

    @abstractmethod
    def build(self, F: int) -> nn.Module | None:
        """The `Mixer`; None hands the feature on as it is."""

    def check_size(self, F: int) -> None:
        """Raises InputError, naming the flag, for invalid settings with features of size F. By default every setting is valid."""


@register
@dataclass(frozen=True)
class OwnFeature(FeatureMix):
    """The anchor's own feature as it is."""

    def width(self, F: int) -> int:
        return F

    def build(self, F: int) -> None:
        """None: nothing is learned."""


@register
@dataclass(frozen=True)
class FeatureBank(FeatureMix):
    """The feature bank of Scaffold-GS.

    It blends every fourth, every second and all channels of the feature by weights that depend on the camera.
    """

    hidden: int = 32
    """Width of the network that predicts the blending weights."""

    def width(self, F: int) -> int:
        return F

    def build(self, F: int) -> Bank:
        return Bank(self.hidden)

    def check_size(self, F: int) -> None:
        """Raises InputError for a feature size that is no multiple of 4."""
        expect_at_least([("--scene.mix.hidden", self.hidden, 1)])
        if F % 4:
            raise InputError(f"expected --scene.F as a multiple of 4 for the feature bank, found {F}; give another size")


class Bank(nn.Module):
    """(w0, w1, w2) = softmax(network(u, d)); f <- w0 tile(f[::4], 4) + w1 tile(f[::2], 2) + w2 f  (Scaffold-GS).

    `tile` repeats the whole strided vector. Tensors are stacked with a leading axis of 1, as every head's are.
    """

    w1: nn.Parameter
    b1: nn.Parameter
    w2: nn.Parameter
    b2: nn.Parameter

    def __init__(self, hidden: int) -> None:
        super().__init__()
        self.w1, self.b1 = linear_init((1, hidden, 4), 4), linear_init((1, hidden), 4)
        self.w2, self.b2 = linear_init((1, 3, hidden), hidden), linear_init((1, 3), hidden)

    def forward(self, table: Table, rows: Tensor, direction: Tensor, distance: Tensor) -> Tensor:
        feature = table.params["feature"].index_select(0, rows)
        x = functional.relu(functional.linear(torch.cat([direction, distance], dim=1), self.w1[0], self.b1[0]))
        w = functional.linear(x, self.w2[0], self.b2[0]).softmax(dim=1)
        return w[:, :1] * feature[:, ::4].repeat(1, 4) + w[:, 1:2] * feature[:, ::2].repeat(1, 2) + w[:, 2:] * feature
