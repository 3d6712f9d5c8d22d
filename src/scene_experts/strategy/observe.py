"""What density control counts, gathered once per iteration for every anchor method.

Statistics of a table ([N] or [N, K]): `visits` views that saw the anchor; `opacity` sum over visits of its positive opacities;
`grad` sum of the norms of the 2D-mean gradients (NDC units) of each slot; `count` how often that slot was drawn.
"""

from __future__ import annotations

import torch

from scene_experts.table import Table
from scene_experts.types import Decoded, Render

STATS = ("visits", "opacity", "grad", "count")


def start(table: Table, K: int) -> None:
    """Begin counting from zero."""
    like = next(iter(table.columns().values()))
    for name, shape in (("visits", ()), ("opacity", ()), ("grad", (K,)), ("count", (K,))):
        table.stats[name] = torch.zeros(len(table), *shape, device=like.device)


def stop(table: Table) -> None:
    """Free the statistics."""
    for name in STATS:
        table.stats.pop(name, None)


@torch.no_grad()
def observe(table: Table, decoded: Decoded, render: Render) -> None:
    """Add one view, after its backward pass. A slot counts when its opacity is positive and its splat touched the picture."""
    stats, rows = table.stats, decoded.rows
    assert decoded.raw_opacity is not None
    stats["visits"].index_add_(0, rows, torch.ones_like(rows, dtype=stats["visits"].dtype))
    stats["opacity"].index_add_(0, rows, decoded.raw_opacity.detach().clamp_min(0).sum(1))
    drawn = (render.radii > 0).nonzero().squeeze(1)
    source = decoded.gaussians.source.index_select(0, drawn)
    norms = render.mean2d_grad.index_select(0, drawn).norm(dim=1)
    stats["grad"].view(-1).index_add_(0, source, norms)
    stats["count"].view(-1).index_add_(0, source, torch.ones_like(norms))
