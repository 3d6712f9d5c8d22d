"""Densification of graph points (SAGS): the rules of Scaffold-GS with one Gaussian per row, placed
by a network."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

from scene_experts.core.parts import register
from scene_experts.core.types import Decoded, Render
from scene_experts.scene import LatticeScene
from scene_experts.strategy.grow import GrowAnchors


@register
@dataclass(frozen=True)
class GrowPoints(GrowAnchors):
    """Densification of SAGS. It differs from that of anchors in the definition of a visit, and it
    does not clamp sizes."""

    grows = "graph points"
    largest_log_size = None

    success_threshold: float = 0.6
    """Share of the interval in which an anchor must be seen before it can be removed; half of it
    before it can grow."""
    visits: Literal["drawn", "seen"] = "drawn"
    """drawn: a view counts only for the points that it draws, so a point that is never drawn is
    never removed (SAGS). seen: a view counts for all points that it decodes."""

    def observe(self, scene: LatticeScene, decoded: Decoded, render: Render, step: int) -> None:
        """Add one view to the statistics, after its backward pass."""
        super().observe(scene, self.counted(decoded, render), render, step)

    def counted(self, decoded: Decoded, render: Render) -> Decoded:
        """Restrict `decoded` to the rows that count as visited."""
        if self.visits == "seen":
            return decoded
        drawn = (render.radii > 0).nonzero().squeeze(1)
        opacity = decoded.gaussians.opacities.detach().index_select(0, drawn)
        return replace(decoded, rows=decoded.gaussians.source.index_select(0, drawn), raw_opacity=opacity[:, None])
