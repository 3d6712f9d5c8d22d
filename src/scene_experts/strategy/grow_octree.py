"""Densification of anchors on the levels of an octree (Octree-GS).

Offsets with a medium mean 2D gradient create anchors on their parent's level. Offsets with a large
mean 2D gradient create anchors on the next finer level. Anchors whose gradients are large on
average also request finer levels from then on. Anchors are removed as in Scaffold-GS.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from scene_experts.core.fields import NotNegative
from scene_experts.core.parts import register
from scene_experts.core.schedule import Every
from scene_experts.scene.anchors.levels import Levels
from scene_experts.scene.anchors.scene import AnchorScene
from scene_experts.strategy.control import AnchorControl
from scene_experts.strategy.errors import find_wrong
from scene_experts.strategy.grow import empty_cells, strongest


@register
@dataclass(frozen=True)
class GrowOctree(AnchorControl[AnchorScene]):
    """Densification of Octree-GS: gradient thresholds grow by the factor fork^update_ratio per
    level."""

    grows = "anchors on levels"

    adjust: Every = Every(1500, 25_000, 100)
    """When densification runs."""
    update_ratio: NotNegative = 0.2
    """The gradient threshold grows by the factor fork^update_ratio from level to level."""
    extra_ratio: float = 0.25
    """Anchors whose mean gradient reaches this share of the threshold of their level request finer
    levels."""
    extra_up: float = 0.01
    """Level increment per densification step."""

    @torch.no_grad()
    def grow(self, scene: AnchorScene, generator: torch.Generator, step: int = 0, cap: int = 0) -> tuple[int, bool]:
        """Create anchors level by level, coarse to fine, up to `cap` anchors in total (0: no
        limit).

        Returns the number of new anchors and whether the limit rejected candidates.
        """
        table, levels = scene.table, scene.select.lattices
        assert levels is not None
        refine = not scene.select.coarse(step)
        eligible, g, mean = self.gradients(table.stats)
        strong = g >= self.grad_threshold  # level 0 has the lowest threshold
        if self.error_views and "wrong" in table.stats:
            strong &= find_wrong(table.stats, self.error_share)
        slots = strong.view(-1).nonzero().squeeze(1)
        strength, parents = g.view(-1).index_select(0, slots), torch.div(slots, scene.K, rounding_mode="floor")
        points = scene.slot_points(slots, parents)
        if self.bounds:
            here = self.inside(points).nonzero().squeeze(1)
            slots, strength, parents, points = (part.index_select(0, here) for part in (slots, strength, parents, points))
        own = table.facts["level"].index_select(0, parents)
        cells = [table.facts["cell"][table.facts["level"] == level] for level in range(levels.count)]
        rows: list[dict[str, Tensor]] = []
        born, capped = 0, False
        for level in range(levels.count):
            low, high = self.threshold(level, levels), self.threshold(level + 1, levels)
            targets = [(level, (own == level) & (strength >= low) & (strength < high))]
            if refine and level + 1 < levels.count and len(cells[level + 1]):
                targets.append((level + 1, (own == level) & (strength >= high)))
            for target, chosen in targets:
                place = levels.units(points[chosen], target)
                found = empty_cells(table.params["feature"], cells[target], place, parents[chosen], strength[chosen], 1)
                if found is None:
                    continue
                keep = levels.wanted(levels.positions(found[0], target).float(), torch.full_like(found[0][:, 0], target))
                new, feature, force = (t[keep] for t in found)
                best = strongest(force, cap, len(table) + born)
                capped |= len(best) < len(new)
                new, feature = new[best], feature[best]
                if len(new):
                    feature = feature if target == level else torch.zeros_like(feature)
                    rows.append(scene.new_rows(new, levels.size(target), feature, target))
                    cells[target], born = torch.cat([cells[target], new]), born + len(new)
        if refine:
            table.facts["extra_level"] = table.facts["extra_level"] + self.extra(mean, table.facts["level"], levels)
        for name in ("grad", "count"):
            table.stats[name].masked_fill_(eligible, 0.0)
        if rows:
            table.append({name: torch.cat([row[name] for row in rows]) for name in rows[0]})
        return born, capped

    def gradients(self, stats: dict[str, Tensor]) -> tuple[Tensor, Tensor, Tensor]:
        """Mean gradients per slot and per anchor.

        Returns the eligible slots [N, K] (bool), their mean gradients [N, K] (0 for other slots),
        and the mean of each anchor over its eligible slots [N].
        """
        eligible = stats["count"] > self.gate()
        g = torch.where(eligible, stats["grad"] / stats["count"].clamp_min(1), 0.0)
        return eligible, g, g.sum(1) / (eligible.sum(1) + 1e-6)

    def threshold(self, level: int, levels: Levels) -> float:
        """Mean 2D gradient (NDC units) above which slots of `level` create anchors.

        Slots above the threshold of `level + 1` create their anchors on that level.
        """
        return self.grad_threshold * float(levels.fork) ** (self.update_ratio * level)

    def extra(self, mean: Tensor, level: Tensor, levels: Levels) -> Tensor:
        """Increments [N] of the level that anchors request, from their mean gradients `mean` [N]
        and levels `level` [N]."""
        thresholds = self.extra_ratio * mean.new_tensor([self.threshold(i, levels) for i in range(levels.count)])
        return self.extra_up * (mean >= thresholds[level]).to(mean.dtype)
