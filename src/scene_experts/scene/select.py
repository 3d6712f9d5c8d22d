"""Which anchors a camera uses, before the visibility filter."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import torch
from torch import Tensor

from scene_experts.table import Table
from scene_experts.types import Camera


class Selector(Protocol):
    def __call__(self, table: Table, camera: Camera, step: int, training: bool) -> Tensor | None:
        """Row indices [S] int64 that may be drawn, or None for all of them."""
        ...


@dataclass(frozen=True)
class AllAnchors:
    """Every anchor, as in Scaffold-GS."""

    def __call__(self, table: Table, camera: Camera, step: int, training: bool) -> Tensor | None:
        return None


def visible_rows(selected: Tensor | None, means: Tensor, scales: Tensor, camera: Camera, cull) -> Tensor:
    """Rows [A] of the selected anchors whose own ellipsoid touches the picture. means [N, 3], scales [N, 3]; no gradient."""
    with torch.no_grad():
        if selected is None:
            return cull(means, scales, camera).nonzero().squeeze(1)
        return selected[cull(means.index_select(0, selected), scales.index_select(0, selected), camera)]
