"""Densification of explicit Gaussians (3DGS, Kerbl et al. 2023, section 5): clone, split, prune,
reset opacities.

Statistics:

- `grad` [N]: sum of the norms of the 2D-mean gradients (NDC units) over the views that drew the
  Gaussian.
- `count` [N]: number of these views.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Annotated, Literal, Self

import torch
from torch import Tensor

from scene_experts.core.fields import Count, Range
from scene_experts.core.parts import register
from scene_experts.core.random import generator_on
from scene_experts.core.schedule import Every
from scene_experts.core.types import Decoded, Render
from scene_experts.geometry.rotation import normalise_quats, quat_to_matrix
from scene_experts.scene.gaussians import GaussianScene
from scene_experts.strategy import Edit, Strategy, observe

SHRINK = 1.6  # factor by which a split divides the scales (3DGS: 0.8 N for N = 2 new Gaussians)


@register
@dataclass(frozen=True)
class SplitClone(Strategy[GaussianScene]):
    """Densification of 3DGS: clone, split and remove Gaussians."""

    grows = "Gaussians"

    adjust: Every = Every(500, 15_000, 100)
    """When densification runs."""
    grad_threshold: float = 0.0002
    """Mean 2D gradient (NDC units) above which a Gaussian is cloned or split."""
    gradient: Literal["signed", "absolute"] = "signed"
    """signed: the gradients of a Gaussian's pixels cancel where they differ in sign. absolute:
    their absolute values are added (AbsGS)."""
    dense_size: float = 0.01
    """Largest size of a cloned Gaussian, as a share of the scene's extent; larger ones are
    split."""
    min_opacity: float = 0.005
    """Gaussians with a lower opacity are removed."""
    max_size: float = 0.1
    """Gaussians larger than this share of the scene's extent are removed after the first opacity
    reset."""
    reset: Every = Every(0, 15_000, 3000)
    """When opacities are reset."""
    reset_least: Count = 1000
    """Minimum number of iterations between resets, however short the training is."""
    reset_opacity: Annotated[float, Range(above=0, below=1)] = 0.01
    """Upper bound of the opacities after a reset."""

    @property
    def absolute(self) -> bool:
        """Whether the statistics use absolute pixel gradients."""
        return self.gradient == "absolute"

    def scaled(self, factor: float) -> Self:
        """Scale the schedule to a training `factor` times as long.

        The reset interval scales too, but not below `reset_least`. The densification interval does
        not change.
        """
        least = min(self.reset_least, self.reset.interval)
        made = super().scaled(factor)
        return replace(made, reset=replace(made.reset, interval=max(1, least, round(self.reset.interval * factor))))

    def count_steps(self, iterations: int) -> int:
        """Number of densification steps in a training of `iterations` iterations."""
        return self.adjust.count(iterations)

    def observe(self, scene: GaussianScene, decoded: Decoded, render: Render, step: int) -> None:
        """Add one view to the statistics, after its backward pass."""
        if not self.enabled or step >= self.adjust.stop:
            return
        stats = scene.table.stats
        if "grad" not in stats:
            like = scene.table.params["raw_opacity"].detach()
            stats |= {"grad": torch.zeros_like(like), "count": torch.zeros_like(like)}
        observe.observe_drawn(stats, decoded, render)

    def reads(self, step: int) -> bool:
        """Whether densification is due at `step`, or the statistics end."""
        return self.adjust.due(step) or step >= self.adjust.stop

    def adds(self, step: int) -> bool:
        return self.enabled and self.adjust.due(step)

    def update(self, scene: GaussianScene, step: int, generator: torch.Generator, cap: int = 0) -> Edit | None:
        """Clone, split, remove and reset Gaussians if due at `step`. Returns None if densification
        is not due.

        `generator` samples the positions of the two halves of a split Gaussian.
        """
        table = scene.table
        if step >= self.adjust.stop:
            table.stats = {}
        if not self.enabled:
            return None
        edit = None
        if self.adjust.due(step) and "grad" in table.stats:
            grown, capped = self.grow(scene, generator, cap)
            pruned = self.prune(scene, step)
            for name in ("grad", "count"):
                table.stats[name].zero_()
            for column in table.params.values():
                column.grad = None  # in 3DGS, the optimiser skips all Gaussians in a densification step
            edit = Edit(grown, pruned, len(table), capped)
        if self.reset.due(step):
            self.press_opacities(scene)
        return edit

    @torch.no_grad()
    def grow(self, scene: GaussianScene, generator: torch.Generator, cap: int = 0) -> tuple[int, bool]:
        """Clone small Gaussians and split large ones where gradients are large, up to `cap`
        Gaussians in total (0: no limit).

        Returns the number of Gaussians gained and whether the limit rejected candidates.
        """
        table = scene.table
        g = table.stats["grad"] / table.stats["count"].clamp_min(1)
        chosen = (g >= self.grad_threshold).nonzero().squeeze(1)
        room = max(0, cap - len(table)) if cap else len(chosen)
        capped = len(chosen) > room
        if capped:
            best = g.index_select(0, chosen).argsort(descending=True, stable=True)[:room]
            chosen = chosen.index_select(0, best).sort().values
        if len(chosen) == 0:
            return 0, capped
        largest = table.params["log_scales"].index_select(0, chosen).amax(1).exp()
        small = largest <= self.dense_size * scene.extent
        halves = split_rows(table.params, chosen[~small], generator)
        copies = {name: column.index_select(0, chosen[small]) for name, column in table.params.items()}
        table.append({name: torch.cat([copies[name], halves[name]]) for name in copies})
        keep = torch.ones(len(table), dtype=torch.bool, device=g.device)
        keep[chosen[~small]] = False
        table.keep(keep)
        return len(chosen), capped

    @torch.no_grad()
    def prune(self, scene: GaussianScene, step: int) -> int:
        """Remove Gaussians of low opacity and, after the first reset, very large ones. Returns the
        number of removed Gaussians."""
        p = scene.table.params
        gone = p["raw_opacity"].sigmoid() < self.min_opacity
        if step > self.reset.interval:
            gone |= p["log_scales"].amax(1).exp() > self.max_size * scene.extent
        if gone.any():
            scene.table.keep(~gone)
        return int(gone.sum())

    @torch.no_grad()
    def press_opacities(self, scene: GaussianScene) -> None:
        """Clamp all opacities to at most `reset_opacity` and reset Adam's moments of the
        opacities."""
        most = math.log(self.reset_opacity / (1 - self.reset_opacity))
        scene.table.assign("raw_opacity", scene.table.params["raw_opacity"].detach().clamp_max(most))


def split_rows(params: torch.nn.ParameterDict, rows: Tensor, generator: torch.Generator) -> dict[str, Tensor]:
    """Split each of the Gaussians `rows` [S] into two; returns columns of 2 S rows, all first
    halves before all second halves.

    Each half has a mean sampled from the original Gaussian and scales divided by 1.6. Its other
    columns are copies.
    """
    halves = {name: torch.cat([column.index_select(0, rows)] * 2) for name, column in params.items()}
    quats, scales = halves["quats"], halves["log_scales"].exp()
    draw = torch.randn(scales.shape, generator=generator_on(scales.device, generator), device=scales.device).to(scales)
    away = (quat_to_matrix(normalise_quats(quats)) @ (draw * scales)[..., None]).squeeze(-1)
    return halves | {"means": halves["means"] + away, "log_scales": halves["log_scales"] - math.log(SHRINK)}
