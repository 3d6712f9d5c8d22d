"""Density control shared by all anchor methods (Scaffold-GS): the statistics, the schedule and the removal of anchors."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Literal, Self

import torch
from typing_extensions import TypeVar

from scene_experts.core.errors import expect_at_least
from scene_experts.core.schedule import Every
from scene_experts.core.types import Decoded, Render
from scene_experts.scene import LatticeScene
from scene_experts.strategy import Edit, Strategy, observe

L = TypeVar("L", bound=LatticeScene, default=LatticeScene)


@dataclass(frozen=True)
class AnchorControl(Strategy[L]):
    """Hyper-parameters of density control for anchors. Subclasses implement `grow`."""

    grows = "anchors"

    start_stat: int = 500
    """Iteration from which statistics are collected."""
    adjust: Every = Every(1500, 15_000, 100)
    """When densification runs."""
    grad_threshold: float = 0.0002
    """Mean 2D gradient (NDC units) above which new anchors are created."""
    gradient: Literal["signed", "absolute"] = "signed"
    """signed: the gradients of a Gaussian's pixels cancel where they differ in sign. absolute: their absolute values are added (AbsGS)."""
    success_threshold: float = 0.8
    """Share of the interval in which an anchor must be seen before it can be removed; half of it before it can grow."""
    min_opacity: float = 0.005
    """Anchors whose mean opacity is lower are removed."""
    scale_clamp: Literal["log0.05", "linear0.05", "off"] = "log0.05"
    """Upper bound of the Gaussians' sizes after each densification step: 0.05 in log space, 0.05 in linear units, or off."""
    max_anchors: int = 0
    """Maximum number of anchors; 0 means no limit. Anchors with the largest gradients are created first."""

    @property
    def absolute(self) -> bool:
        """Whether the statistics use absolute pixel gradients."""
        return self.gradient == "absolute"

    def scaled(self, factor: float) -> Self:
        """Scale the schedule to a training `factor` times as long. The interval, gates and thresholds do not change."""
        return replace(self, start_stat=round(self.start_stat * factor), adjust=self.adjust.scaled(factor))

    def count_steps(self, iterations: int) -> int:
        """Number of densification steps in a training of `iterations` iterations."""
        return self.adjust.count(iterations)

    def check(self) -> None:
        """Validate the settings. Raises InputError with the name of the flag for invalid settings."""
        expect_at_least([("--growth.adjust.interval", self.adjust.interval, 1), ("--growth.max-anchors", self.max_anchors, 0)])

    def observe(self, scene: L, decoded: Decoded, render: Render, step: int) -> None:
        """Add one view to the statistics, after its backward pass."""
        if not self.enabled or not self.start_stat < step < self.adjust.stop:
            return
        if "visits" not in scene.table.stats:
            observe.start(scene.table, scene.K)
        observe.observe(scene.table, decoded, render)

    def update(self, scene: L, step: int, generator: torch.Generator, cap: int = 0) -> Edit | None:
        """Create and remove anchors if densification is due at `step`. Returns None if it is not due.

        `generator` selects the candidates that random elimination removes.
        """
        if step >= self.adjust.stop:
            observe.stop(scene.table)
        if not self.enabled or not self.adjust.due(step) or "visits" not in scene.table.stats:
            return None
        for column in scene.table.params.values():
            column.grad = None  # in Scaffold-GS, the optimiser skips all anchors in a densification step
        grown, capped = self.grow(scene, generator, step, cap)
        pruned = self.prune(scene)
        return Edit(grown, pruned, len(scene.table), capped)

    def grow(self, scene: L, generator: torch.Generator, step: int = 0, cap: int = 0) -> tuple[int, bool]:
        """Create anchors, up to `cap` anchors in total (0: no limit).

        Returns the number of new anchors and whether the limit rejected candidates.
        """
        raise NotImplementedError

    def gate(self) -> float:
        """Number of views that must draw a slot before the slot can create an anchor: more than 40 of 100 by default."""
        return self.adjust.interval * self.success_threshold * 0.5

    @torch.no_grad()
    def prune(self, scene: L) -> int:
        """Remove anchors that were seen often enough and have a low mean opacity. Returns the number of removed anchors.

        Also resets the statistics of all anchors that were seen often enough, and clamps the sizes of the Gaussians.
        """
        table = scene.table
        seen = table.stats["visits"] > self.adjust.interval * self.success_threshold  # 80 of 100 by default
        faint = seen & (table.stats["opacity"] < self.min_opacity * table.stats["visits"])
        for name in ("visits", "opacity"):
            table.stats[name][seen] = 0.0
        pruned = int(faint.sum())
        if pruned:
            table.keep(~faint)
        if self.scale_clamp != "off":
            table.params["log_scaling"][:, 3:].clamp_(max=0.05 if self.scale_clamp == "log0.05" else math.log(0.05))
        return pruned
