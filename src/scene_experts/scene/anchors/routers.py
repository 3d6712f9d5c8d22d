"""Routers: which experts decode an anchor, and with which weights. Both depend on the anchor alone,
never on the view.

A router is a part (its settings, a subclass of `Router`) that builds a module (a subclass of
`RouterModule`). `--scene.decoder.router NAME` chooses a registered part by its name. The fused
decode takes choices and weights as inputs, so a new router needs no kernel. Symbols: A anchors, F
feature size, E experts, k chosen experts.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor, nn
from torch.nn import functional

from scene_experts.core.parts import Part, register
from scene_experts.core.types import Mode, Routing
from scene_experts.scene.anchors.mlp import linear_init

LEAST_MARGIN = 1e-4  # added to margins: the weights stay finite where all gates are equal
Companions = Callable[[Tensor], list[Tensor]]
"""Returns the tensors that follow a parameter, each of its shape: Adam's moments, its average."""


class RouterModule(nn.Module, ABC):
    """Computes the routing of one attribute. Its parameters have the learning rate of routers."""

    @abstractmethod
    def forward(self, feature: Tensor, position: Tensor | None, k: int | None, mode: Mode = Mode.DRAW) -> tuple[Routing, Tensor]:
        """Route anchors to k experts each, or to all (None, the dense mixture).

        feature [A, F]; position [A, 3], divided by the scene's extent, or None where it is unknown.

        Returns:
            The gates of all experts and the chosen ones, for losses and figures; the weights of the
            chosen experts [A, k], or of all [A, E] while dense.
        """

    def alone(self, k: int | None) -> int | None:
        """Return the expert that decodes every anchor with weight 1 in this phase, or None."""
        return None

    def fused(self) -> tuple[Tensor, Tensor, bool] | None:
        """Return the weights [E, F] or [E, F + 3] and bias [E] of a linear router with softmax
        weights, and whether it sees positions: kernels compute it themselves. None: `forward`
        routes, and kernels take its result."""
        return None

    def begin(
        self, networks: nn.Module, before: int, step: int, warmup: int, positions: Callable[[], Tensor], companions: Companions
    ) -> None:
        """Prepare for training iteration `step`, see `Scene.begin_iteration`. networks: the
        `Networks` of the mixture."""

    def end_batch(self, views: int) -> None:
        """Learn what no gradient teaches, see `Scene.end_batch`."""


@dataclass(frozen=True)
class Router(Part, ABC):
    """Settings of a router."""

    name: ClassVar[str]
    """Name on the command line."""
    learns: ClassVar[bool] = True
    """Whether losses train the router. Otherwise load balancing and the learning rate of routers
    have no effect."""
    sums_to_one: ClassVar[bool] = True
    """Whether the weights of the chosen experts sum to 1. With k = 1 the picture then does not
    train the router."""

    @abstractmethod
    def build(self, experts: int, feature: int) -> RouterModule:
        """Build the module for `experts` experts and features of `feature` channels."""


@register
@dataclass(frozen=True)
class Linear(Router):
    """The paper's "simple linear layer". g = softmax(W f + b) (eq. 3); Top-k takes the largest
    logits, and w_i = g_i / sum of the chosen g_j (eq. 5)."""

    name = "linear"

    input_pos: bool = False
    """Append the anchor's position, divided by the scene's extent, to the router's input (the
    paper's appendix)."""

    def build(self, experts: int, feature: int) -> LinearModule:
        return LinearModule(experts, feature, self.input_pos)


class LinearModule(RouterModule):
    """Parameters: w [E, F], or [E, F + 3] with positions, and b [E]."""

    w: nn.Parameter
    b: nn.Parameter

    def __init__(self, experts: int, feature: int, input_pos: bool = False) -> None:
        super().__init__()
        inputs = feature + 3 * input_pos
        self.input_pos = input_pos
        self.w, self.b = linear_init((experts, inputs), inputs), linear_init((experts,), inputs)

    def logits(self, feature: Tensor, position: Tensor | None) -> Tensor:
        """Return the logits [A, E]."""
        if self.input_pos:
            if position is None:
                raise ValueError("expected anchor positions for a router with input_pos, found none")
            feature = torch.cat([feature, position], dim=1)
        return functional.linear(feature, self.w, self.b)

    def forward(self, feature: Tensor, position: Tensor | None, k: int | None, mode: Mode = Mode.DRAW) -> tuple[Routing, Tensor]:
        logits = self.logits(feature, position)
        gates = logits.softmax(dim=1)
        if k is None:
            return Routing(gates, None), gates
        chosen = self.choose(logits, k, mode)
        return Routing(gates, chosen), self.weigh(logits, gates, chosen)

    def choose(self, logits: Tensor, k: int, mode: Mode) -> Tensor:
        """Return the experts [A, k] of each anchor."""
        return top_k(logits, k)

    def weigh(self, logits: Tensor, gates: Tensor, chosen: Tensor) -> Tensor:
        """Return the weights [A, k] of the chosen experts."""
        return logits.gather(1, chosen).softmax(dim=1)  # eq. 5

    def fused(self) -> tuple[Tensor, Tensor, bool] | None:
        return self.w, self.b, self.input_pos


@register
@dataclass(frozen=True)
class Margin(Linear):
    """A linear router whose weights are proportional to a gate minus the largest gate that is not
    chosen, so that no weight jumps where two experts change ranks."""

    name = "margin"

    def build(self, experts: int, feature: int) -> MarginModule:
        return MarginModule(experts, feature, self.input_pos)


class MarginModule(LinearModule):
    """w_i = (g_i - r + LEAST_MARGIN) / sum over the chosen, r = the largest gate that is not chosen
    (0 if all are)."""

    def weigh(self, logits: Tensor, gates: Tensor, chosen: Tensor) -> Tensor:
        rest = gates.scatter(1, chosen, 0.0).amax(dim=1, keepdim=True)
        margin = gates.gather(1, chosen) - rest + LEAST_MARGIN
        return margin / margin.sum(dim=1, keepdim=True)

    def fused(self) -> None:
        return None


def top_k(logits: Tensor, k: int) -> Tensor:
    """Return indices [A, k] of the k largest logits [A, E], largest first. Ties go to the lowest
    index on every device."""
    remaining, chosen = logits.detach(), []
    for _ in range(k):
        best = remaining.argmax(dim=1, keepdim=True)  # the first of equal maxima
        chosen.append(best)
        remaining = remaining.scatter(1, best, -torch.inf)
    return torch.cat(chosen, dim=1)
