"""The mixture of experts of the paper (section 3.2): dense mixture, Top-k mixture, curriculum.
`routers.py` has the routers.

Symbols: A anchors, F feature size, D input size, E experts, k chosen experts. g are the gates,
which depend only on the anchor.
    dense  (eq. 4)  y = sum_i g_i E_i(z)                          for the first `warmup` iterations
    sparse (eq. 5)  y = sum_{i in Top-k} w_i E_i(z),  w_i = g_i / sum_{j in Top-k} g_j, the softmax
    over the k chosen logits
The load-balancing losses L_load^S and L_load^D (eq. 6, 7) are in `losses.py`.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Annotated, Literal

import torch
from torch import Tensor, nn
from torch.nn import functional

from scene_experts.core.errors import InputError
from scene_experts.core.fields import CHOSEN, SCALES, Count, Flag, Needs, Range
from scene_experts.core.parts import register
from scene_experts.core.types import Mode, Routing
from scene_experts.scene import EXPERTS, ROUTERS
from scene_experts.scene.anchors.mlp import ACTIVATIONS, ATTRIBUTES, MLP, Attribute, Decoder, HeadWeights, linear_init
from scene_experts.scene.anchors.routers import Companions, Linear, Router, RouterModule

log: logging.Logger = logging.getLogger(__name__)
Init = Literal["independent", "clone_jitter", "variance"]


@register
@dataclass(frozen=True)
class Experts(Decoder):
    """A mixture of experts for each attribute."""

    num: Count = 5
    """Number of experts per attribute."""
    top_k: Annotated[int | None, Range(1)] = 2
    """Number of experts per anchor after the warm-up; none keeps the dense mixture."""
    warmup: Annotated[int, Range(0), SCALES] = 1500
    """Iterations with the dense mixture before Top-k. --iterations rescales it."""
    attributes: tuple[Attribute, ...] = ATTRIBUTES
    """Attributes that have experts. The others have one network."""
    expert_init: Annotated[Init, Needs(ROUTERS)] = "independent"
    """independent: initialise each expert on its own. clone_jitter: copies of one network with
    small noise. variance: independent, with the last layers times sqrt(num), so that the outputs of
    the dense mixture vary as much as those of one network."""
    router: Annotated[Router, CHOSEN, Needs(EXPERTS)] = Linear()
    """How experts are chosen and weighed."""

    @property
    def with_experts(self) -> tuple[str, ...]:
        return self.attributes

    @property
    def dense_until(self) -> int:
        return self.warmup

    @property
    def has(self) -> frozenset[str]:
        if self.num == 1 or not self.attributes:
            return frozenset()
        return frozenset({EXPERTS, ROUTERS} if self.router.learns else {EXPERTS})

    def check(self, flag: Flag) -> None:
        if self.top_k is not None and self.top_k > self.num:
            raise InputError(
                f"expected {flag('top_k')} of at most the number of experts ({self.num}), found {self.top_k}; change it or {flag('num')}"
            )

    def build(self, attribute: str, inputs: int, hidden: int, outputs: int, feature: int) -> Mixture | MLP:
        """Build the head of an attribute: [A, inputs] and features [A, feature] to [A, outputs]."""
        if self.num == 1 or attribute not in self.attributes:
            return MLP(attribute, inputs, hidden, outputs)
        if self.router.learns and self.router.sums_to_one and self.top_k == 1 and attribute == self.attributes[0]:
            log.warning("with top_k 1 and renormalised weights the picture does not train the routers; only L_load does")
        return Mixture(self, attribute, inputs, hidden, outputs, feature)


class Networks(nn.Module):
    """E two-layer networks of one attribute: w1 [E, H, D], b1 [E, H], w2 [E, out, H], b2 [E,
    out]."""

    w1: nn.Parameter
    b1: nn.Parameter
    w2: nn.Parameter
    b2: nn.Parameter

    def __init__(self, attribute: str, count: int, inputs: int, hidden: int, outputs: int, init: Init = "independent") -> None:
        super().__init__()
        self.attribute, self.count = attribute, count
        stacked = lambda shape, fan_in: nn.Parameter(torch.cat([linear_init((1, *shape), fan_in).data for _ in range(count)]))  # noqa: E731
        self.w1, self.b1 = stacked((hidden, inputs), inputs), stacked((hidden,), inputs)
        self.w2, self.b2 = stacked((outputs, hidden), hidden), stacked((outputs,), hidden)
        if init == "clone_jitter":
            for p in self.parameters():
                p.data[1:] = p.data[:1] * (1.0 + 0.01 * torch.randn_like(p.data[1:]))
        if init == "variance":  # a mean of E independent outputs has 1 / E of their variance
            self.w2.data.mul_(math.sqrt(count))
            self.b2.data.mul_(math.sqrt(count))

    def one(self, i: int, x: Tensor) -> Tensor:
        """Return the activated outputs [A, out] of expert i for x [A, D]."""
        hidden = functional.relu(functional.linear(x, self.w1[i], self.b1[i]))
        return ACTIVATIONS[self.attribute](functional.linear(hidden, self.w2[i], self.b2[i]))

    def all(self, x: Tensor, w: Tensor) -> Tensor:
        """Compute all experts and return sum_i w_i E_i(x). w [A, E]."""
        return sum((w[:, i : i + 1] * self.one(i, x) for i in range(self.count)), start=x.new_zeros(()))  # type: ignore[return-value]

    def chosen(self, x: Tensor, chosen: Tensor, w: Tensor) -> Tensor:
        """Return the same sum over the chosen experts [A, k]: each is computed only for the anchors
        that chose it."""
        A, k = chosen.shape
        order = chosen.reshape(-1).argsort(stable=True)
        counts = torch.bincount(chosen.reshape(-1), minlength=self.count).tolist()
        rows = torch.div(order, k, rounding_mode="floor")
        parts = [self.one(i, part) for i, part in enumerate(x.index_select(0, rows).split(counts)) if len(part)]
        if not parts:
            return x.new_zeros(A, self.w2.shape[1])
        y = torch.cat(parts) * w.reshape(-1, 1).index_select(0, order)
        return torch.zeros(A, y.shape[1], dtype=y.dtype, device=y.device).index_add(0, rows, y)


class Mixture(nn.Module):
    """A sparsely gated mixture for one attribute: networks and a router."""

    networks: Networks
    router: RouterModule
    in_two_phases = True

    def __init__(self, config: Experts, attribute: str, inputs: int, hidden: int, outputs: int, feature: int) -> None:
        super().__init__()
        self.config, self.experts = config, config.num
        init = config.expert_init if config.router.learns else "independent"  # otherwise one network begins alone
        self.networks = Networks(attribute, config.num, inputs, hidden, outputs, init)
        self.router = config.router.build(config.num, feature)

    def k(self, step: int) -> int | None:
        """Return the number of experts per anchor at `step`, or None if dense. Iterations 1 ..
        warmup are dense."""
        return None if self.config.top_k is None or step <= self.config.warmup else self.config.top_k

    def begin(self, before: int, step: int, positions: Callable[[], Tensor], companions: Companions) -> None:
        self.router.begin(self.networks, before, step, self.config.warmup, positions, companions)

    def end_batch(self, views: int) -> None:
        self.router.end_batch(views)

    def route(self, feature: Tensor, step: int, position: Tensor | None = None, mode: Mode = Mode.DRAW) -> tuple[Routing, Tensor]:
        """Return the routing and the mixture weights: [A, E] if dense, [A, k] otherwise."""
        return self.router(feature, position, self.k(step), mode)

    def forward(
        self, x: Tensor, feature: Tensor, step: int, position: Tensor | None = None, mode: Mode = Mode.DRAW
    ) -> tuple[Tensor, Routing | None]:
        """x [A, D], feature [A, F] -> activated mixture [A, out], routing."""
        routing, w = self.route(feature, step, position, mode)
        alone = self.router.alone(self.k(step))
        if alone is not None:
            return self.networks.one(alone, x), routing
        return self.networks.all(x, w) if routing.chosen is None else self.networks.chosen(x, routing.chosen, w), routing

    def weights(self, step: int) -> HeadWeights:
        k, own = self.k(step), self.networks
        alone = self.router.alone(k)
        if alone is not None:
            only = slice(alone, alone + 1)
            return HeadWeights(None, None, own.w1[only], own.b1[only], own.w2[only], own.b2[only], None)
        w, b, position = self.router.fused() or (None, None, False)
        return HeadWeights(w, b, own.w1, own.b1, own.w2, own.b2, k, position=position)

    def network_parameters(self) -> list[nn.Parameter]:
        return list(self.networks.parameters())

    def router_parameters(self) -> list[nn.Parameter]:
        return list(self.router.parameters())

    def tensors(self) -> dict[str, nn.Parameter]:
        networks, router = self.networks.named_parameters(), self.router.named_parameters()
        return dict(networks) | {f"router_{name}": parameter for name, parameter in router}
