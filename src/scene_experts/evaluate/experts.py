"""How the anchors of a scene are shared among the experts of each attribute (what the MoE-GS paper's Figure 3 draws)."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Protocol

import torch

from scene_experts.core.types import Routing


class Routed(Protocol):
    """A scene that can say who decodes what. Routing does not depend on the camera."""

    def routing(self, step: int) -> dict[str, Routing]: ...


@dataclass(frozen=True)
class Shares:
    """One attribute over all N anchors, per expert (E values each)."""

    share: list[float] | None  # assignments / (N k), sums to 1; None while the mixture is dense
    per_anchor: list[float] | None  # assignments / N, sums to k; None while the mixture is dense
    first: list[float]  # share of anchors whose largest gate is this expert's, sums to 1
    mean_gate: list[float]  # sums to 1
    entropy: float  # mean over anchors of -sum_i g_i ln g_i / ln E: 1 all experts alike, 0 one alone
    k: int | None  # experts per anchor; None: dense


def shares(routing: Routing) -> Shares:
    """The shares of one attribute; all zero for a scene without anchors."""
    n, experts = routing.gates.shape
    gates = routing.gates.double()
    count = max(n, 1)
    first = torch.bincount(gates.argmax(dim=1), minlength=experts).double() / count
    entropy = float(torch.special.entr(gates).sum()) / count / math.log(experts) if experts > 1 else 0.0
    assigned, k = None, None
    if routing.chosen is not None:
        k = routing.chosen.shape[1]
        assigned = torch.bincount(routing.chosen.reshape(-1), minlength=experts).double() / count
    return Shares(
        share=None if assigned is None or k is None else (assigned / k).tolist(),
        per_anchor=None if assigned is None else assigned.tolist(),
        first=first.tolist(),
        mean_gate=(gates.sum(0) / count).tolist(),
        entropy=entropy,
        k=k,
    )


@torch.no_grad()
def expert_shares(scene: Routed, step: int) -> dict[str, Shares]:
    """Shares by attribute over all anchors of the scene; empty without experts."""
    return {attribute: shares(routing) for attribute, routing in scene.routing(step).items()}
