"""Features that decoders receive: the anchor's own feature, or a blend of several resolutions
(Scaffold-GS's feature bank).

Routers always receive the raw feature. Routing therefore depends on the anchor and not on the view.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Protocol

import torch
from torch import Tensor, nn
from torch.nn import functional

from scene_experts.core.errors import InputError
from scene_experts.core.fields import Count
from scene_experts.core.parts import Part, register
from scene_experts.core.table import Table
from scene_experts.scene.anchors.mlp import linear_init


class Mixer(Protocol):
    """A module that computes the features of anchors `rows` [A] for one camera. The `mix` rate
    applies to its parameters."""

    def __call__(self, table: Table, rows: Tensor, direction: Tensor, distance: Tensor) -> Tensor:
        """direction [A, 3] of unit length, camera to anchor; distance [A, 1] in trained world units
        -> [A, width]."""
        ...


@dataclass(frozen=True)
class FeatureMix(Part, ABC):
    """Settings of the features that decoders receive."""

    @abstractmethod
    def width(self, F: int) -> int:
        """Return the size of the decoders' features, for anchor features of size F."""

    @abstractmethod
    def build(self, F: int) -> nn.Module | None:
        """Build the `Mixer`. None passes the feature on unchanged."""

    def check_size(self, F: int) -> None:
        """Raises InputError, naming the flag, for invalid settings with features of size F. By
        default every setting is valid."""


@register
@dataclass(frozen=True)
class OwnFeature(FeatureMix):
    """The anchor's own feature, unchanged."""

    def width(self, F: int) -> int:
        return F

    def build(self, F: int) -> None:
        """Return None: the feature is passed on unchanged."""


@register
@dataclass(frozen=True)
class FeatureBank(FeatureMix):
    """The feature bank of Scaffold-GS.

    It blends every fourth, every second and all channels of the feature with camera-dependent
    weights.
    """

    hidden: Count = 32
    """Width of the network that predicts the blending weights."""

    def width(self, F: int) -> int:
        return F

    def build(self, F: int) -> Bank:
        return Bank(self.hidden)

    def check_size(self, F: int) -> None:
        """Raises InputError for a feature size that is not a multiple of 4."""
        if F % 4:
            raise InputError(f"expected --scene.F as a multiple of 4 for the feature bank, found {F}; give another size")


class Bank(nn.Module):
    """(w0, w1, w2) = softmax(network(u, d)); f <- w0 tile(f[::4], 4) + w1 tile(f[::2], 2) + w2 f
    (Scaffold-GS).

    `tile` repeats the whole strided vector. Tensors have a leading axis of 1, as in every head.
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
