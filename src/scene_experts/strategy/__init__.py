"""Strategies: how a scene's rows grow and shrink during training. A strategy is its hyper-parameters; its memory is in `table.stats`."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol

import torch

from scene_experts.core.types import Decoded, Render


@dataclass(frozen=True)
class Edit:
    """What one adjustment did."""

    grown: int
    pruned: int
    anchors: int  # rows afterwards
    capped: bool = False  # the cap on rows held some back


class Strategy(Protocol):
    """Called once per iteration, after the backward pass: first `observe`, then `update`; after the optimiser's step, `finish`."""

    @property
    def max_anchors(self) -> int:
        """Never more rows than this; 0 is no cap."""
        ...

    def observe(self, scene: Any, decoded: Decoded, render: Render, step: int) -> None: ...

    def update(self, scene: Any, step: int, generator: torch.Generator) -> Edit | None: ...

    def finish(self, scene: Any, step: int, rates: dict[str, float], generator: torch.Generator) -> None: ...

    def scaled(self, factor: float) -> Any: ...

    def check(self) -> None: ...
