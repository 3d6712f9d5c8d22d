"""A method as another package would add it: a scene family, its learning rates, a loss term, an optimiser and a growth rule.

The scene is a set of round, plainly coloured Gaussians.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor, nn

from scene_experts.core.parts import register
from scene_experts.core.schedule import Every, Rate
from scene_experts.core.table import Table
from scene_experts.core.types import Camera, Decoded, Gaussians, Mode, Points
from scene_experts.scene import Cull, LearningRates, Scene, SceneConfig, Traits
from scene_experts.strategy import Edit, Strategy
from scene_experts.training.config import Train
from scene_experts.training.losses import Sample, Weights
from scene_experts.training.optim import Optimizer


@register
@dataclass(frozen=True)
class Dots(SceneConfig):
    """Round Gaussians of one size and of one colour each."""

    family = "dots"

    size: float = 0.2
    """Standard deviation at the start, trained world units."""

    @property
    def grown_as(self) -> str:
        return "dots"

    def start(self, points: Points, extent: float, cameras: Sequence[Camera] = ()) -> DotScene:
        xyz = points.xyz.float()
        log_size = torch.full((len(xyz), 1), self.size).log()
        table = Table({"xyz": xyz, "log_size": log_size, "rgb": points.rgb.float() / 255}, {"id": torch.arange(len(xyz))})
        return DotScene(table, extent)

    def load(self, table: Table, meta: dict[str, Any]) -> DotScene:
        return DotScene(table, float(meta["extent"]))


class DotScene(Scene):
    traits = Traits("dots", "dots", sh_degree=0)
    K = 1
    file_values = 7

    @property
    def positions(self) -> Tensor:
        return self.table.params["xyz"].detach()

    def forward(self, camera: Camera, step: int, mode: Mode, cull: Cull) -> Decoded:
        p = self.table.params
        size = p["log_size"].exp().expand(-1, 3)
        rows = cull(p["xyz"].detach(), size.detach().contiguous(), camera).nonzero().squeeze(1)
        quats = torch.tensor([[1.0, 0.0, 0.0, 0.0]]).expand(len(rows), -1)
        means, scales, colors = p["xyz"][rows], size[rows], p["rgb"][rows].clamp_min(0)
        return Decoded(Gaussians(means, quats, scales, torch.full((len(rows),), 0.5), colors, rows), rows, None, {})

    def rate_groups(self) -> dict[str, list[nn.Parameter]]:
        return {name: [column] for name, column in self.table.params.items()}

    def meta(self) -> dict[str, Any]:
        return {"extent": self.extent}


@register
@dataclass(frozen=True)
class DotRates(LearningRates):
    """Learning rates of dots."""

    family = "dots"

    xyz: Rate = Rate(0.01, 0.001)
    log_size: Rate = Rate(0.01, 0.01)
    rgb: Rate = Rate(0.1, 0.1)

    def at(self, group: str, step: int, total: int, extent: float) -> float:
        return getattr(self, group).at(step, total)


@register
@dataclass(frozen=True)
class Halve(Strategy[DotScene]):
    """Drops every second dot when due."""

    grows = "dots"

    adjust: Every = Every(0, 20_000, 3_000)
    """When to drop."""

    def update(self, scene: DotScene, step: int, generator: torch.Generator, cap: int = 0) -> Edit | None:
        if not self.adjust.due(step):
            return None
        n = len(scene.table)
        scene.table.keep(torch.arange(n) % 2 == 0)
        return Edit(0, n - len(scene.table), len(scene.table))


@register
@dataclass(frozen=True)
class Momentum(Optimizer):
    """Stochastic gradient descent with momentum."""

    momentum: float = 0.9

    def build(self, groups: list[dict[str, Any]]) -> torch.optim.Optimizer:
        return torch.optim.SGD(groups, lr=0.0, momentum=self.momentum)


@register
@dataclass(frozen=True)
class DotWeights(Weights):
    """With a term that keeps dots small."""

    small: float = 0.01
    """Weight of the mean size."""


def size_term(w: DotWeights, sample: Sample) -> dict[str, Tensor]:
    return {"size": w.small * sample.decoded.gaussians.scales.mean()} if w.small else {}


DotWeights.terms = (*Weights.terms, size_term)

dots = Train(
    recipe="dots", scene=Dots(), loss=DotWeights(scale=0.0), growth=Halve(), rates=DotRates(), optimizer=Momentum(), iterations=30_000
)
