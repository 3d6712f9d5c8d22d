"""Densification strategies: they add rows to a scene and remove rows from it during training."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Any, ClassVar, Generic, Self

import torch
from typing_extensions import TypeVar

from scene_experts.core.fields import CountOrNone
from scene_experts.core.parts import Part
from scene_experts.core.types import Decoded, Render
from scene_experts.scene import Scene
from scene_experts.strategy.survey import Survey

S = TypeVar("S", bound=Scene, default=Any)


@dataclass(frozen=True)
class Edit:
    """Result of one densification step, in rows."""

    grown: int
    pruned: int
    anchors: int  # number of rows after the step
    capped: bool = False  # the limit on the number of rows rejected some candidates


@dataclass(frozen=True)
class Strategy(Part, Generic[S], ABC):
    """Hyper-parameters of a densification strategy for scenes of class S. The flags are under
    --growth.

    The strategy keeps its running statistics in `table.stats`. After the backward pass of a view,
    the training calls `observe`. After the last view of a batch it calls `survey` and `update` for
    each iteration of the batch, and `finish` after the optimiser's step. A batch has one view by
    default. Several processes share its views: each observes its own views, the statistics are then
    added up, and every process makes the same changes.
    """

    grows: ClassVar[str]
    """What the rule grows; `SceneConfig.grown_as` of its scenes."""

    max_anchors: CountOrNone = 0
    """Maximum number of rows; 0 means no limit. Rows with the largest gradients are created first."""
    enabled: bool = True
    """Whether rows are added and removed at all."""

    @property
    def absolute(self) -> bool:
        """Whether the statistics use absolute pixel gradients (`types.Render.mean2d_grad`)."""
        return False

    @property
    def box(self) -> tuple[float, ...]:
        """Low and high corner (x, y, z, x, y, z) of the box in which rows are created, in trained
        world units; empty means everywhere."""
        return ()

    def within(self, box: tuple[float, ...]) -> Self:
        """Return the rule that creates rows in a box only (see `box`); the rule itself if it knows no
        such limit or has one."""
        return self

    def needs_whole_table(self) -> str:
        """Return the setting that needs all rows in every process, for the message of --shard; ""
        if none does. The default refuses."""
        return "this growth rule"

    def count_steps(self, iterations: int) -> int | None:
        """Number of densification steps in a training of `iterations` iterations; None if
        unknown."""
        return None

    def observe(self, scene: S, decoded: Decoded, render: Render, step: int) -> None:
        """Add one view to the statistics. The default does nothing. It may only add to sums, and
        create sums of zeros: other processes add other views."""

    def reads(self, step: int) -> bool:
        """Whether `survey` or `update` at `step` reads or removes statistics, or removes rows. The
        default is the safe answer, True.

        Several processes exchange their statistics only then.
        """
        return True

    def adds(self, step: int) -> bool:
        """Whether `update` at `step` may add rows. The default is the safe answer, True.

        With --max-memory, memory is measured and given back only then. On a GPU, what drew the
        rows is made anew after it.
        """
        return True

    def survey(self, scene: S, survey: Survey, step: int, generator: torch.Generator) -> None:
        """Look at further training views before `update`. The default does nothing. generator: the
        only source of randomness."""

    @abstractmethod
    def update(self, scene: S, step: int, generator: torch.Generator, cap: int = 0) -> Edit | None:
        """Add and remove rows if densification is due at `step`. Returns None if it is not due.

        generator: the only source of randomness.
        cap: maximum number of rows at this step (`max_anchors`, or the number that fits in memory);
        0 means no limit.
        """

    def finish(self, scene: S, step: int, rates: dict[str, float], generator: torch.Generator) -> None:
        """Run after the optimiser's step. The default does nothing. rates: the current learning
        rates by group."""
