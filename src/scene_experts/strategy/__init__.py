"""Strategies: how a scene's rows grow and shrink during training (densification)."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Any, ClassVar, Generic

import torch
from typing_extensions import TypeVar

from scene_experts.core.parts import Part
from scene_experts.core.types import Decoded, Render
from scene_experts.scene import Scene

S = TypeVar("S", bound=Scene, default=Any)


@dataclass(frozen=True)
class Edit:
    """What one densification step did."""

    grown: int
    pruned: int
    anchors: int  # rows afterwards
    capped: bool = False  # the cap on rows held some back


@dataclass(frozen=True)
class Strategy(Part, Generic[S], ABC):
    """Hyper-parameters of a growth rule for scenes of class S; flags under --growth. What it remembers is in `table.stats`.

    Called once per iteration, after the backward pass: first `observe`, then `update`; after the optimiser's step, `finish`.
    """

    grows: ClassVar[str]
    """What the rule grows; `SceneConfig.grown_as` of its scenes."""

    max_anchors: int = 0
    """Never more rows than this; 0 is no cap."""
    enabled: bool = True
    """Whether rows are added and removed at all."""

    def count_steps(self, iterations: int) -> int | None:
        """How often the rule densifies in a training of `iterations`; None where it does not say."""
        return None

    def observe(self, scene: S, decoded: Decoded, render: Render, step: int) -> None:
        """Count one view. By default nothing is counted."""

    @abstractmethod
    def update(self, scene: S, step: int, generator: torch.Generator, cap: int = 0) -> Edit | None:
        """Add and remove rows where that is due at `step`; None where nothing was due.

        generator: the only source of randomness.  cap: never more rows than this now (`max_anchors`, or what memory allows); 0 is no cap.
        """

    def finish(self, scene: S, step: int, rates: dict[str, float], generator: torch.Generator) -> None:
        """Called after the optimiser's step; rates: the learning rates in use, by group. By default nothing is done."""
