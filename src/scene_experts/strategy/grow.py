"""Growing and pruning anchors (Scaffold-GS), on an integer lattice.

Every `interval` iterations, offsets whose mean 2D gradient is large found anchors in empty cells of three lattices, coarse to
fine; anchors whose offsets stay faint are removed. Cells are integers throughout, so no device disagrees about which is taken.
"""

from __future__ import annotations

import logging
import math
from dataclasses import dataclass, replace
from typing import Literal

import torch
from torch import Tensor

from scene_experts.errors import expect_at_least
from scene_experts.geometry.voxel import AXIS_LIMIT, coarsen, in_set, pack, scatter_max
from scene_experts.scene.anchors import AnchorScene
from scene_experts.schedule import Every
from scene_experts.strategy import Edit, observe
from scene_experts.table import Table
from scene_experts.types import Decoded, Render

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class GrowAnchors:
    """Hyper-parameters of density control; its memory is in `table.stats`."""

    start_stat: int = 500
    adjust: Every = Every(1500, 15_000, 100)
    """Adjust at multiples of `interval` strictly inside (start, stop); statistics are kept from start_stat to stop."""
    grad_threshold: float = 0.0002
    success_threshold: float = 0.8
    min_opacity: float = 0.005
    levels: int = 3
    init_factor: int = 16
    hierarchy_factor: int = 4
    scale_clamp: Literal["log0.05", "linear0.05", "off"] = "log0.05"
    """After each adjustment, Gaussian size bounds (log-scaling 3..5) are held below 0.05 in log or linear units."""
    elimination: bool = True
    """Let only a random part of the candidates through: half at the coarsest level, then 3/4, then 7/8."""
    parity_level_skip: bool = False
    """Scaffold-GS's quirk: no finer level is tried once a call has added nothing so far."""
    max_anchors: int = 0
    """Never more anchors than this; 0 is no cap. The largest gradients go first."""
    enabled: bool = True

    def scaled(self, factor: float) -> GrowAnchors:
        """The same in a training `factor` times as long: windows scale; interval, gates and thresholds stay."""
        return replace(self, start_stat=round(self.start_stat * factor), adjust=self.adjust.scaled(factor))

    def check(self) -> None:
        """Raises InputError for numbers that no training can have."""
        expect_at_least(
            [
                ("--growth.adjust.interval", self.adjust.interval, 1),
                ("--growth.hierarchy-factor", self.hierarchy_factor, 2),
                ("--growth.max-anchors", self.max_anchors, 0),
            ]
        )

    def finish(self, scene: AnchorScene, step: int, rates: dict[str, float], generator: torch.Generator) -> None:
        """Nothing is left to do after the optimiser's step."""

    def observe(self, scene: AnchorScene, decoded: Decoded, render: Render, step: int) -> None:
        """Count one view, after its backward pass."""
        if not self.enabled or not self.start_stat < step < self.adjust.stop:
            return
        if "visits" not in scene.table.stats:
            observe.start(scene.table, scene.K)
        observe.observe(scene.table, decoded, render)

    def update(self, scene: AnchorScene, step: int, generator: torch.Generator) -> Edit | None:
        """Grow and prune when due. `generator` draws the random elimination."""
        if step >= self.adjust.stop:
            observe.stop(scene.table)
        if not self.enabled or not self.adjust.due(step) or "visits" not in scene.table.stats:
            return None
        grown, capped = self.grow(scene, generator)
        pruned = self.prune(scene)
        for column in scene.table.params.values():
            column.grad = None  # Scaffold-GS's anchors miss the step of an adjustment, whether it changed a row or not
        return Edit(grown, pruned, len(scene.table), capped)

    def cell_factors(self) -> list[int]:
        """Cell edges of the levels in fine voxels, coarse to fine (16, 4, 1); levels whose factor would be 0 do not exist."""
        factors = [self.init_factor // self.hierarchy_factor**level for level in range(self.levels)]
        return [f for f in factors if f > 0]

    @torch.no_grad()
    def grow(self, scene: AnchorScene, generator: torch.Generator) -> tuple[int, bool]:
        """Found anchors where gradients are large. Returns how many, and whether the cap held some back."""
        table, stats = scene.table, scene.table.stats
        gate = self.adjust.interval * self.success_threshold * 0.5  # 40 of 100
        eligible = (stats["count"].view(-1) > gate).nonzero().squeeze(1)  # flat slots, row * K + k
        g = stats["grad"].view(-1).index_select(0, eligible) / stats["count"].view(-1).index_select(0, eligible).clamp_min(1)
        strong = (g >= self.grad_threshold).nonzero().squeeze(1)  # the first threshold is the lowest
        slots, g = eligible.index_select(0, strong), g.index_select(0, strong)
        parents = torch.div(slots, scene.K, rounding_mode="floor")
        points = slot_points(table, slots, parents)
        cells, rows, born, capped = table.facts["cell"], [], 0, False
        for level, factor in enumerate(self.cell_factors()):
            if self.parity_level_skip and level > 0 and not born:
                continue
            chosen = g >= self.grad_threshold * (self.hierarchy_factor // 2) ** level
            if self.elimination:
                draw = torch.rand(stats["grad"].shape, generator=generator).view(-1).to(g.device)
                chosen &= draw.index_select(0, slots) > 0.5 ** (level + 1)
            found = empty_cells(scene, cells, points[chosen], parents[chosen], g[chosen], factor)
            if found is None:
                continue
            new, feature, strength = found
            if self.max_anchors and len(table) + born + len(new) > self.max_anchors:
                capped = True
                room = max(0, self.max_anchors - len(table) - born)
                best = strength.argsort(descending=True, stable=True)[:room].sort().values
                new, feature = new[best], feature[best]
            if len(new):
                rows.append(scene.new_rows(new * factor, scene.voxel * factor, feature))
                cells, born = torch.cat([cells, rows[-1]["cell"]]), born + len(new)
        for name in ("grad", "count"):
            stats[name].view(-1).index_fill_(0, eligible, 0.0)
        if rows:
            table.append({name: torch.cat([row[name] for row in rows]) for name in rows[0]})
        return born, capped

    @torch.no_grad()
    def prune(self, scene: AnchorScene) -> int:
        """Remove anchors seen often enough and found faint; start the count of the well-seen ones anew; clamp sizes."""
        table = scene.table
        seen = table.stats["visits"] > self.adjust.interval * self.success_threshold  # 80 of 100
        faint = seen & (table.stats["opacity"] < self.min_opacity * table.stats["visits"])
        for name in ("visits", "opacity"):
            table.stats[name][seen] = 0.0
        pruned = int(faint.sum())
        if pruned:
            table.keep(~faint)
        if self.scale_clamp != "off":
            table.params["log_scaling"][:, 3:].clamp_(max=0.05 if self.scale_clamp == "log0.05" else math.log(0.05))
        return pruned


def slot_points(table: Table, slots: Tensor, rows: Tensor) -> Tensor:
    """Where the Gaussians of flat `slots` [P] of anchors `rows` [P] are, [P, 3] float64."""
    scaling = table.params["log_scaling"][:, :3].exp().index_select(0, rows)
    offsets = table.params["offsets"].view(-1, 3).index_select(0, slots)
    return table.facts["xyz"].index_select(0, rows).double() + (offsets * scaling).double()


def empty_cells(
    scene: AnchorScene, taken: Tensor, points: Tensor, parents: Tensor, g: Tensor, factor: int
) -> tuple[Tensor, Tensor, Tensor] | None:
    """Cells (in units of `factor` voxels) that candidate points [P, 3] fall into and none of the `taken` fine cells [N, 3] is in.

    Returns cells [n, 3] int64, features [n, F] (element-wise maximum over the parents of all points in the cell) and the
    largest gradient [n]; None for no cell.
    """
    if len(points) == 0:
        return None
    fine = torch.floor(points / scene.voxel + 0.5)  # rounded once; coarser cells follow in integers, as the anchors' own do
    inside = (fine.abs() < AXIS_LIMIT - factor).all(1)  # an offset that ran away founds nothing
    cells, parents, g = coarsen(fine[inside].long(), factor), parents[inside], g[inside]
    if len(cells) == 0:
        return None
    keys, group = torch.unique(pack(cells), return_inverse=True)
    free = (~in_set(keys, pack(coarsen(taken, factor)))).nonzero().squeeze(1)
    if len(free) == 0:
        return None
    slot = torch.full_like(keys, -1)
    slot[free] = torch.arange(len(free), device=keys.device)
    target = slot[group]
    mine = (target >= 0).nonzero().squeeze(1)
    target, parents = target[mine], parents[mine]
    feature = scatter_max(scene.table.params["feature"].index_select(0, parents), target, len(free))
    strength = scatter_max(g[mine, None], target, len(free)).squeeze(1)
    first = torch.full((len(free),), len(cells), device=keys.device).scatter_reduce(0, target, mine, "amin")
    return cells.index_select(0, first), feature, strength
