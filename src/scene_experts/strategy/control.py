"""Density control shared by all anchor methods (Scaffold-GS): the statistics, the schedule and the
removal of anchors."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Annotated, ClassVar, Literal, Self

import torch
from torch import Tensor
from typing_extensions import TypeVar

from scene_experts.core.errors import InputError
from scene_experts.core.fields import SCALES, CountOrNone, Flag, NotNegative, Range
from scene_experts.core.schedule import Every
from scene_experts.core.types import Decoded, Render
from scene_experts.scene import LatticeScene
from scene_experts.strategy import Edit, Strategy, errors, observe
from scene_experts.strategy.survey import Survey

L = TypeVar("L", bound=LatticeScene, default=LatticeScene)


@dataclass(frozen=True)
class AnchorControl(Strategy[L]):
    """Hyper-parameters of density control for anchors. Subclasses implement `grow`."""

    grows = "anchors"
    largest_log_size: ClassVar[float | None] = 0.05
    """Upper bound of the logarithms of the Gaussians' sizes after each densification step, as in
    Scaffold-GS; None: no bound."""

    start_stat: Annotated[int, SCALES] = 500
    """Iteration from which statistics are collected."""
    adjust: Every = Every(1500, 15_000, 100)
    """When densification runs."""
    grad_threshold: float = 0.0002
    """Mean 2D gradient (NDC units) above which new anchors are created."""
    gradient: Literal["signed", "absolute"] = "signed"
    """signed: the gradients of a Gaussian's pixels cancel where they differ in sign. absolute:
    their absolute values are added (AbsGS)."""
    success_threshold: float = 0.8
    """Share of the interval in which an anchor must be seen before it can be removed; half of it
    before it can grow."""
    min_opacity: float = 0.005
    """Anchors whose mean opacity is lower are removed."""
    error_views: CountOrNone = 0
    """Number of random training views whose errors decide at each densification step where anchors
    are created (FastGS); 0 means that errors do not count."""
    error_quantile: Annotated[float, Range(0, below=1)] = 0.7
    """Quantile of a view's pixel errors above which an error is high."""
    error_share: NotNegative = 0.3
    """Share of a Gaussian's contribution that must lie on pixels with high errors before it can
    create an anchor."""
    least_contribution: NotNegative = 0.0
    """Anchors that contribute less than this many pixels to each of at least 8 of the error views
    are removed; 0 removes none."""
    mask_contribution: NotNegative = 0.0
    """Gaussians of an anchor that contribute less than this many pixels to every training view are
    no longer drawn, and anchors without others are removed; 0 masks none."""
    mask_at: Annotated[tuple[int, ...], SCALES] = (20_000, 30_000)
    """Iterations at which Gaussians are masked."""
    mask_views: CountOrNone = 0
    """Number of random training views that a mask looks at; 0 means all."""
    bounds: tuple[float, ...] = ()
    """Corners (low x, y, z, high x, y, z) of the box in which anchors are created, in trained world
    units; empty means everywhere. Blocks of a large capture use it."""

    @property
    def absolute(self) -> bool:
        """Whether the statistics use absolute pixel gradients."""
        return self.gradient == "absolute"

    @property
    def box(self) -> tuple[float, ...]:
        return self.bounds

    def within(self, box: tuple[float, ...]) -> Self:
        return self if self.bounds else replace(self, bounds=box)

    def count_steps(self, iterations: int) -> int:
        """Number of densification steps in a training of `iterations` iterations."""
        return self.adjust.count(iterations)

    def check(self, flag: Flag) -> None:
        low, high = self.bounds[:3], self.bounds[3:]
        if self.bounds and not (len(high) == 3 and all(a < b for a, b in zip(low, high))):
            found = " ".join(f"{side:g}" for side in self.bounds)
            raise InputError(f"expected {flag('bounds')} as a low and a high corner, x y z x y z, found {found}; correct the numbers")
        if self.least_contribution > 0 and not self.error_views:
            raise InputError(f"expected {flag('error_views')} with {flag('least_contribution')}, found none; give for example 8 views")

    def observe(self, scene: L, decoded: Decoded, render: Render, step: int) -> None:
        """Add one view to the statistics, after its backward pass."""
        if not self.enabled or not self.start_stat < step < self.adjust.stop:
            return
        if "visits" not in scene.table.stats:
            observe.start(scene.table, scene.K)
        observe.observe(scene.table, decoded, render)

    def reads(self, step: int) -> bool:
        """Whether anchors are created or removed at `step`, or the statistics end."""
        return self.adjust.due(step) or step >= self.adjust.stop or step in self.mask_at

    def adds(self, step: int) -> bool:
        return self.enabled and self.adjust.due(step)

    def survey(self, scene: L, survey: Survey, step: int, generator: torch.Generator) -> None:
        """Measure errors over random training views before densification, and the contributions of
        all slots before a mask."""
        if self.error_views and self.grows_at(scene, step):
            errors.observe_errors(scene, survey, self.error_views, self.error_quantile, step, generator)
        if self.mask_contribution > 0 and self.enabled and step in self.mask_at:
            scene.table.stats["contribution"] = errors.measure_contributions(scene, survey, self.mask_views, step, generator)

    def grows_at(self, scene: L, step: int) -> bool:
        """Whether densification is due at `step`."""
        return self.enabled and self.adjust.due(step) and "visits" in scene.table.stats

    def update(self, scene: L, step: int, generator: torch.Generator, cap: int = 0) -> Edit | None:
        """Create and remove anchors if densification or a mask is due at `step`. Returns None if
        neither is due.

        `generator` selects the candidates that random elimination removes.
        """
        if step >= self.adjust.stop:
            observe.stop(scene.table)
            for name in errors.STATS:
                scene.table.stats.pop(name, None)
        contribution = scene.table.stats.pop("contribution", None)
        masked = None if contribution is None else errors.mask_slots(scene.table, contribution, self.mask_contribution)
        if not self.grows_at(scene, step):
            return None if masked is None else Edit(0, masked, scene.table.total)
        for column in scene.table.params.values():
            column.grad = None  # in Scaffold-GS, the optimiser skips all anchors in a densification step
        grown, capped = self.grow(scene, generator, step, cap)
        pruned = self.prune(scene)
        return Edit(grown, pruned + (masked or 0), scene.table.total, capped)

    def grow(self, scene: L, generator: torch.Generator, step: int = 0, cap: int = 0) -> tuple[int, bool]:
        """Create anchors, up to `cap` anchors in total (0: no limit).

        Returns the number of new anchors and whether the limit rejected candidates.
        """
        raise NotImplementedError

    def inside(self, points: Tensor) -> Tensor:
        """Return which points [P, 3] lie in the box in which anchors are created, [P] bool. Its low
        sides belong to it."""
        low, high = (torch.tensor(side, dtype=points.dtype, device=points.device) for side in (self.bounds[:3], self.bounds[3:]))
        return ((points >= low) & (points < high)).all(1)

    def gate(self) -> float:
        """Number of views that must draw a slot before the slot can create an anchor: more than 40
        of 100 by default."""
        return self.adjust.interval * self.success_threshold * 0.5

    @torch.no_grad()
    def prune(self, scene: L) -> int:
        """Remove anchors that were seen often enough and have a low mean opacity. Returns the
        number of removed anchors.

        Also resets the statistics of all anchors that were seen often enough, and clamps the sizes
        of the Gaussians.
        """
        table = scene.table
        seen = table.stats["visits"] > self.adjust.interval * self.success_threshold  # 80 of 100 by default
        faint = seen & (table.stats["opacity"] < self.min_opacity * table.stats["visits"])
        if self.least_contribution > 0 and "reach" in table.stats:
            faint |= errors.find_unneeded(table.stats, self.least_contribution)
        for name in ("visits", "opacity"):
            table.stats[name][seen] = 0.0
        pruned = table.drop(faint)
        if self.largest_log_size is not None:
            table.params["log_scaling"][:, 3:].clamp_(max=self.largest_log_size)
        return pruned
