"""Densification of anchors on an integer lattice (Scaffold-GS).

Every `interval` iterations, offsets with a large mean 2D gradient create anchors in the empty cells
of three lattices, from coarse to fine. Anchors with a low mean opacity are removed. Cells are
integers, so all devices agree on which cells are occupied.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import torch
from torch import Tensor

from scene_experts.core.fields import Count, Range, flag_of
from scene_experts.core.parts import register
from scene_experts.core.random import generator_on
from scene_experts.core.shard import NUMBER, ShardedTable
from scene_experts.geometry.voxel import AXIS_LIMIT, coarsen, in_set, pack, scatter_max
from scene_experts.strategy.control import AnchorControl, L
from scene_experts.strategy.errors import find_wrong
from scene_experts.strategy.grow_shards import Candidates

_COLUMNS = 8  # columns of the features that are copied at once


@register
@dataclass(frozen=True)
class GrowAnchors(AnchorControl[L]):
    """Densification of Scaffold-GS."""

    levels: Count = 3
    """Number of voxel sizes at which anchors are created in one step."""
    init_factor: Count = 16
    """Voxel size of the coarsest of these levels, in units of the scene's voxel size."""
    hierarchy_factor: Annotated[int, Range(2)] = 4
    """Ratio of the voxel sizes of two successive levels."""
    elimination: bool = True
    """Keep only a random part of the candidates: half at the coarsest level, then 3/4, then 7/8."""

    def cell_factors(self) -> list[int]:
        """Cell edges of the levels, coarse to fine, in units of the scene's voxel size: [16, 4, 1]
        by default.

        Levels with a factor of 0 are left out.
        """
        factors = [self.init_factor // self.hierarchy_factor**level for level in range(self.levels)]
        return [f for f in factors if f > 0]

    @torch.no_grad()
    def grow(self, scene: L, generator: torch.Generator, step: int = 0, cap: int = 0) -> tuple[int, bool]:
        """Create anchors where gradients are large, up to `cap` anchors in total (0: no limit).

        Returns the number of new anchors and whether the limit rejected candidates.
        """
        table = scene.table  # `search` frees its buffers before the columns are copied
        rows, born, capped = (
            self.search_shards(scene, table, generator, cap) if isinstance(table, ShardedTable) else self.search(scene, generator, cap)
        )
        if rows:
            table.append({name: torch.cat([row[name] for row in rows]) for name in rows[0]})
        return born, capped

    def needs_whole_table(self) -> str:
        surveys = ("error_views", "least_contribution", "mask_contribution")
        return next((flag_of(f"growth.{name}") for name in surveys if getattr(self, name)), "")

    def search(self, scene: L, generator: torch.Generator, cap: int = 0) -> tuple[list[dict[str, Tensor]], int, bool]:
        """Find the anchors to create and reset the statistics of the slots that were seen often
        enough.

        Returns the new rows by level, their number, and whether the limit rejected candidates.
        """
        table, stats = scene.table, scene.table.stats
        eligible, slots, g, parents, fine = self.candidates(scene)
        features = table.params["feature"]
        cells, rows, born, capped = table.facts["cell"], [], 0, False
        for level, factor in enumerate(self.cell_factors()):
            chosen = g >= self.grad_threshold * (self.hierarchy_factor // 2) ** level
            if self.elimination:
                own = generator_on(g.device, generator)
                draw = torch.rand(stats["grad"].shape, generator=own, device=g.device).view(-1)
                chosen &= draw.index_select(0, slots) > 0.5 ** (level + 1)
            found = empty_cells(features, cells, fine[chosen], parents[chosen], g[chosen], factor)
            if found is None:
                continue
            new, feature, strength = found
            best = strongest(strength, cap, len(table) + born)
            if len(best) < len(new):
                capped, new, feature = True, new[best], feature[best]
            if len(new):
                rows.append(scene.new_rows(new * factor, scene.voxel * factor, feature))
                cells, born = torch.cat([cells, rows[-1]["cell"]]), born + len(new)
        for name in ("grad", "count"):
            stats[name].view(-1).index_fill_(0, eligible, 0.0)
        return rows, born, capped

    def candidates(self, scene: L) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
        """Return the slots that were seen often enough, [e], and those whose gradients are large
        enough for a level.

        The latter have their flat indices [s], mean gradients [s], rows [s] and positions [s, 3] in
        units of fine voxels.
        """
        stats = scene.table.stats
        eligible = (stats["count"].view(-1) > self.gate()).nonzero().squeeze(1)  # flat slot index: row * K + k
        g = stats["grad"].view(-1).index_select(0, eligible) / stats["count"].view(-1).index_select(0, eligible).clamp_min(1)
        strong = g >= self.grad_threshold  # the first level has the lowest threshold
        if self.error_views and "wrong" in stats:
            strong &= find_wrong(stats, self.error_share).view(-1).index_select(0, eligible)
        strong = strong.nonzero().squeeze(1)
        slots, g = eligible.index_select(0, strong), g.index_select(0, strong)
        parents = torch.div(slots, scene.K, rounding_mode="floor")
        points = scene.slot_points(slots, parents)
        if self.bounds:
            here = self.inside(points).nonzero().squeeze(1)
            slots, g, parents, points = (part.index_select(0, here) for part in (slots, g, parents, points))
        return eligible, slots, g, parents, points / scene.voxel

    def search_shards(
        self, scene: L, table: ShardedTable, generator: torch.Generator, cap: int = 0
    ) -> tuple[list[dict[str, Tensor]], int, bool]:
        """Do the same as `search` for a table that is divided among several processes. Returns the
        new rows of this process."""
        stats = table.stats
        eligible, slots, g, parents, fine = self.candidates(scene)
        cells, rows, born, capped = table.facts["cell"], [], 0, False
        for level, factor in enumerate(self.cell_factors()):
            chosen = g >= self.grad_threshold * (self.hierarchy_factor // 2) ** level
            if self.elimination:
                chosen &= table.draw(generator, slots, scene.K) > 0.5 ** (level + 1)
            found = Candidates(table, table.params["feature"], cells, fine[chosen], parents[chosen], g[chosen], factor)
            best = strongest(found.strength, cap, table.total + born)
            capped |= len(best) < len(found.cells)
            numbers = table.total + born + torch.arange(len(best), device=best.device)
            own, feature = table.owned(numbers), found.features_of(best, numbers % table.group.size)
            new = found.cells[best[own]]
            rows.append({**scene.new_rows(new * factor, scene.voxel * factor, feature), NUMBER: numbers[own]})
            cells, born = torch.cat([cells, rows[-1]["cell"]]), born + len(best)
        for name in ("grad", "count"):
            stats[name].view(-1).index_fill_(0, eligible, 0.0)
        return rows, born, capped


def strongest(strength: Tensor, cap: int, rows: int) -> Tensor:
    """Indices of the candidates to keep so that a table of `rows` rows stays within `cap` rows (0:
    no limit).

    strength [n]: gradients of the candidates. The strongest candidates are kept, in their original
    order.
    """
    if not cap or rows + len(strength) <= cap:
        return torch.arange(len(strength), device=strength.device)
    return strength.argsort(descending=True, stable=True)[: max(0, cap - rows)].sort().values


def empty_cells(
    features: Tensor, taken: Tensor, fine: Tensor, parents: Tensor, g: Tensor, factor: int
) -> tuple[Tensor, Tensor, Tensor] | None:
    """Find the empty cells, in units of `factor` voxels, that contain candidate points.

    features [N, F]: features of the table.  taken [N, 3]: occupied fine cells.
    fine [P, 3] float64: candidate points in units of fine voxels.  parents [P]: their rows.  g [P]:
    their gradients. Returns cells [n, 3] int64, features [n, F] (element-wise maximum over the
    parents of all points in a cell) and the largest gradient per cell [n]. Returns None if there is
    no empty cell.
    """
    if len(fine) == 0:
        return None
    fine = torch.floor(fine + 0.5)  # round once; integer arithmetic derives the coarser cells, as for the anchors
    inside = (fine.abs() < AXIS_LIMIT - factor).all(1)  # points outside the lattice create no anchors
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
    parts = features.split(_COLUMNS, dim=1)  # a copy of all columns for each point would be most of the memory of this function
    feature = torch.cat([scatter_max(part.index_select(0, parents), target, len(free)) for part in parts], dim=1)
    strength = scatter_max(g[mine, None], target, len(free)).squeeze(1)
    first = torch.full((len(free),), len(cells), device=keys.device).scatter_reduce(0, target, mine, "amin")
    return cells.index_select(0, first), feature, strength
