"""Densification by sampling (3DGS as Markov chain Monte Carlo, Kheradmand et al. 2024): relocate,
add and perturb Gaussians.

The method's two regularisers are loss weights: `Weights.mean_opacity` and `Weights.mean_size`.
"""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass
from typing import Annotated

import torch
from torch import Tensor

from scene_experts.core.fields import CountOrNone, NotNegative, Range
from scene_experts.core.parts import register
from scene_experts.core.random import generator_on
from scene_experts.core.schedule import Every
from scene_experts.geometry.rotation import normalise_quats, quat_to_matrix
from scene_experts.native import library as native
from scene_experts.scene.gaussians import GaussianScene
from scene_experts.strategy import Edit, Strategy

MOST = 51  # maximum number of Gaussians that replace one Gaussian
_SHARP = 100.0  # slope of the sigmoid that reduces the noise of opaque Gaussians


@register
@dataclass(frozen=True)
class MCMC(Strategy[GaussianScene]):
    """Densification of 3DGS-MCMC: relocate and add Gaussians. It keeps no statistics."""

    grows = "Gaussians"

    adjust: Every = Every(500, 25_000, 100)
    """When Gaussians are relocated and added."""
    min_opacity: float = 0.005
    """Gaussians with a lower opacity are relocated."""
    growth: Annotated[float, Range(1)] = 1.05
    """Factor by which the number of Gaussians grows in one step, at most."""
    noise: NotNegative = 500_000.0
    """Scale of the noise on positions, times their learning rate; 0 means no noise."""
    max_anchors: CountOrNone = 1_000_000
    """Maximum number of Gaussians; 0 means no limit."""

    def count_steps(self, iterations: int) -> int:
        """Number of densification steps in a training of `iterations` iterations."""
        return self.adjust.count(iterations)

    def adds(self, step: int) -> bool:
        return self.enabled and self.adjust.due(step)

    def update(self, scene: GaussianScene, step: int, generator: torch.Generator, cap: int = 0) -> Edit | None:
        """Relocate and add Gaussians if densification is due at `step`. Returns None if it is not
        due.

        `generator` samples the Gaussians to copy.
        """
        if not self.enabled or not self.adjust.due(step) or len(scene.table) == 0:
            return None
        self.relocate(scene, generator)
        grown, capped = self.add(scene, generator, cap)
        for column in scene.table.params.values():
            column.grad = None  # as in 3DGS, the optimiser skips all Gaussians in a densification step
        return Edit(grown, 0, len(scene.table), capped)

    @torch.no_grad()
    def relocate(self, scene: GaussianScene, generator: torch.Generator) -> int:
        """Move each dead Gaussian onto a live one, sampled in proportion to opacity. Returns the
        number of moved Gaussians."""
        table = scene.table
        opacity = table.params["raw_opacity"].sigmoid()
        dead = (opacity <= self.min_opacity).nonzero().squeeze(1)
        if not 0 < len(dead) < len(table):
            return 0
        weight = torch.where(opacity <= self.min_opacity, 0.0, opacity)
        sources = draw(weight, len(dead), generator)
        self.share(scene, sources)
        table.overwrite(dead, {name: column.index_select(0, sources) for name, column in table.params.items()})
        return len(dead)

    @torch.no_grad()
    def add(self, scene: GaussianScene, generator: torch.Generator, cap: int = 0) -> tuple[int, bool]:
        """Add copies of Gaussians sampled in proportion to opacity, up to `cap` Gaussians in total
        (0: no limit).

        Returns the number of new Gaussians and whether the limit rejected some.
        """
        table, n = scene.table, len(scene.table)
        wanted = int(self.growth * n)
        target = min(cap, wanted) if cap else wanted
        if target <= n:
            return 0, target < wanted
        sources = draw(table.params["raw_opacity"].sigmoid(), target - n, generator)
        self.share(scene, sources)
        table.append({name: column.index_select(0, sources) for name, column in table.params.items()})
        return target - n, target < wanted

    def share(self, scene: GaussianScene, sources: Tensor) -> None:
        """Adjust the opacity and scale of the Gaussians `sources` [D] for their copies, and reset
        their optimiser moments.

        An index that occurs c times in `sources` has c copies, so c + 1 Gaussians replace the
        original one.
        """
        rows, drawn = sources.unique(return_counts=True)
        p = scene.table.params
        opacity = p["raw_opacity"].index_select(0, rows).sigmoid()
        new, factor = share_opacity(opacity, drawn + 1)
        new = new.clamp(self.min_opacity, 1 - torch.finfo(torch.float32).eps)
        log_scales = p["log_scales"].index_select(0, rows) + factor.log()[:, None]
        scene.table.overwrite(rows, {"raw_opacity": new.logit(), "log_scales": log_scales}, clear=True)

    @torch.no_grad()
    def finish(self, scene: GaussianScene, step: int, rates: dict[str, float], generator: torch.Generator) -> None:
        """Add noise to the positions after the optimiser's step.

        The noise follows the covariance of each Gaussian and vanishes for opaque Gaussians.
        """
        size = self.noise * rates["means"]
        if not self.enabled or size == 0:
            return
        p = scene.table.params
        columns = [p[name].detach() for name in ("means", "quats", "log_scales", "raw_opacity")]
        means = p["means"].detach()
        eta = torch.randn(means.shape, generator=generator_on(means.device, generator), device=means.device).to(means)
        library = native.load()
        if library is not None and all(c.device.type == "cpu" and c.dtype == torch.float32 and c.is_contiguous() for c in columns):
            where = [native.pointer(t) for t in (*columns, eta)]
            library.se_mcmc_add_noise(*where, len(eta), size, _SHARP, self.min_opacity, native.count_threads())
        else:
            means, quats, log_scales, raw_opacity = columns
            disturb(means, quats, log_scales, raw_opacity, eta, size, self.min_opacity)


def disturb(means: Tensor, quats: Tensor, log_scales: Tensor, raw_opacity: Tensor, eta: Tensor, size: float, faint: float) -> None:
    """Compute means += Sigma eta size sigmoid(-100 (opacity - faint)) in place, in PyTorch, for any
    device and dtype."""
    gate = torch.sigmoid(-_SHARP * (raw_opacity.sigmoid() - faint))
    turn = quat_to_matrix(normalise_quats(quats))
    along = (turn.transpose(1, 2) @ eta[..., None]).squeeze(-1) * (2 * log_scales).exp()
    means += (turn @ along[..., None]).squeeze(-1) * (gate * size)[:, None]


def draw(weight: Tensor, count: int, generator: torch.Generator) -> Tensor:
    """Sample indices [count] with replacement, in proportion to `weight` [N] >= 0. At least one
    weight must be positive."""
    total = weight.double().cumsum(0)
    own = generator_on(total.device, generator)
    at = torch.rand(count, generator=own, dtype=torch.float64, device=total.device) * total[-1]
    return torch.searchsorted(total, at, right=True).clamp_max_(int(weight.nonzero()[-1]))


def share_opacity(opacity: Tensor, n: Tensor) -> tuple[Tensor, Tensor]:
    """Opacity and scale factor, both [D], of n [D] (at most 51) equal Gaussians that replace one
    Gaussian of `opacity` [D].

    The new opacity is o' = 1 - (1 - o)^(1/n). The scale factor is o / Q with
    Q = sum_{i=1..n} sum_{k=0..i-1} binom(i-1, k) (-1)^k o'^(k+1) / sqrt(k+1) (eq. 9 of the paper).
    The hockey-stick identity gives Q = sum_{j=1..n} binom(n, j) (-1)^(j-1) o'^j / sqrt(j). The
    signs alternate, so the sum is computed in float64.
    """
    n, o = n.clamp(1, MOST), opacity.double()
    new = 1 - (1 - o) ** (1 / n)
    powers = new[:, None] ** torch.arange(1, MOST + 1, device=o.device)
    Q = (powers * _signed_binomials().to(o.device)[n]).sum(1)
    return new.to(opacity.dtype), (o / Q).to(opacity.dtype)


@functools.cache
def _signed_binomials() -> Tensor:
    """Table of binom(n, j) (-1)^(j-1) / sqrt(j) for n = 0 .. MOST (rows) and j = 1 .. MOST
    (columns), float64."""
    rows = [[math.comb(n, j) * (-1) ** (j - 1) / math.sqrt(j) for j in range(1, MOST + 1)] for n in range(MOST + 1)]
    return torch.tensor(rows, dtype=torch.float64)
