"""Growth and removal of anchors by errors over several views (after FastGS, Ren et al. 2025), and
masks of slots that no view needs.

Statistics of a table, beside those of `observe`:

- `covered` [N, K]: contribution of the slot to the sampled views, px; each densification step
  halves the older sum.
- `wrong` [N, K]: the part of it on pixels with high errors.
- `looks` [N]: sampled views that saw the anchor since its last test.
- `reach` [N]: largest contribution of the anchor to one of them, px.
"""

from __future__ import annotations

from functools import partial

import torch
from torch import Tensor

from scene_experts.core.table import Table
from scene_experts.scene import LatticeScene
from scene_experts.strategy.survey import Survey, weigh_all, weigh_errors

STATS = ("covered", "wrong", "looks", "reach")
LOOKS = 8  # sampled views that must see an anchor before it can be removed
SLOTS = "slots"  # fact [N, K] bool: the slots that are drawn


@torch.no_grad()
def observe_errors(scene: LatticeScene, survey: Survey, count: int, quantile: float, step: int, generator: torch.Generator) -> None:
    """Add `count` random training views to the statistics."""
    table, K = scene.table, scene.K
    like = next(iter(table.params.values()))
    if "covered" not in table.stats:
        for name, shape in zip(STATS, ((K,), (K,), (), ())):
            table.stats[name] = like.new_zeros(len(table), *shape)
    stats = table.stats
    for name in ("covered", "wrong"):
        stats[name].mul_(0.5)
    for view in survey.sample(count, generator):
        decoded, sums = survey.see(scene, view, step, partial(weigh_errors, quantile=quantile))
        source = decoded.gaussians.source
        stats["covered"].view(-1).index_add_(0, source, sums[:, 0])
        stats["wrong"].view(-1).index_add_(0, source, sums[:, 1])
        of_row = like.new_zeros(len(table)).index_add_(0, torch.div(source, K, rounding_mode="floor"), sums[:, 0])
        stats["reach"] = torch.maximum(stats["reach"], of_row)
        stats["looks"].index_add_(0, decoded.rows, torch.ones_like(decoded.rows, dtype=like.dtype))


def find_wrong(stats: dict[str, Tensor], share: float) -> Tensor:
    """Return [N, K] bool: slots with at least `share` of their contribution on pixels with high
    errors."""
    return (stats["wrong"] >= share * stats["covered"]) & (stats["covered"] > 0)


@torch.no_grad()
def find_unneeded(stats: dict[str, Tensor], least: float) -> Tensor:
    """Return [N] bool: anchors that contribute less than `least` px to each of at least LOOKS
    views. Tested anchors begin anew."""
    tested = stats["looks"] >= LOOKS
    unneeded = tested & (stats["reach"] < least)
    for name in ("looks", "reach"):
        stats[name][tested] = 0.0
    return unneeded


@torch.no_grad()
def measure_contributions(scene: LatticeScene, survey: Survey, count: int, step: int, generator: torch.Generator) -> Tensor:
    """Return the largest contribution of each slot to one of `count` training views (0: all of
    them), [N, K] px."""
    like = next(iter(scene.table.params.values()))
    most = like.new_zeros(len(scene.table) * scene.K)
    for view in survey.sample(count, generator):
        decoded, sums = survey.see(scene, view, step, weigh_all)
        source = decoded.gaussians.source  # a slot occurs once
        most.index_copy_(0, source, torch.maximum(most.index_select(0, source), sums[:, 0]))
    return most.view(-1, scene.K)


@torch.no_grad()
def mask_slots(table: Table, contribution: Tensor, least: float) -> int:
    """Mask the slots that contribute less than `least` px, [N, K], and remove anchors without other
    slots. Returns their number.

    A masked slot stays masked. With one slot per row, rows are removed and no mask is kept.
    """
    keep = contribution >= least
    if SLOTS in table.facts:
        keep &= table.facts[SLOTS]
    some = keep.any(1)
    if keep.shape[1] > 1:
        table.facts[SLOTS] = keep
    gone = int((~some).sum())
    if gone:
        table.keep(some)
    return gone
