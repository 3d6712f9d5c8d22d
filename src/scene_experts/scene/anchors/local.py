"""Experts for places: one network per attribute learns first; then each part of the scene goes on with its own copy of it.

For iterations 1 .. warmup, expert 0 decodes every anchor. Then all experts become copies of it, with its Adam moments (sparse upcycling,
Komatsuzaki et al. 2023), so the picture does not change. From then on an anchor at x is decoded by the expert of the nearest centre:
    I = argmin_i |x - c_i|^2 = argmax_i (2 c_i x - |c_i|^2) / s
The centres c_i are those of k-means over the anchors' positions, divided by the scene's extent, and s is the mean squared distance to the
nearest of them. The router of `MixtureHead` computes this with weights that are not trained. Anchors do not move, so no anchor ever
changes its expert, and none needs a balancing loss.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, ClassVar

import torch
from torch import Tensor

from scene_experts.core.errors import InputError
from scene_experts.core.parts import register
from scene_experts.core.types import Mode, Routing
from scene_experts.scene.anchors.experts import Experts, MixtureHead, Router
from scene_experts.scene.anchors.mlp import ACTIVATIONS, HeadWeights

SAMPLE = 20_000  # positions that k-means looks at
ROUNDS = 100  # of k-means at most
MARGIN = 0.02  # share of the positions that k-means ignores at either end of each axis: far background


@register
@dataclass(frozen=True)
class LocalExperts(Experts):
    """A mixture of experts in which each part of the scene has its own expert."""

    num: int = 5
    """Number of experts per attribute."""
    top_k: int | None = 1
    """Number of experts per anchor after the warm-up: those of the nearest places."""
    warmup: int = 10_000
    """Iterations in which one network decodes every anchor. Then each expert starts as a copy of it. --iterations rescales it."""
    router: Router = Router(input_pos=True)

    learns_routing: ClassVar[bool] = False

    @property
    def unused(self) -> tuple[str, ...]:
        return ("loss.load", "rates.router_scale", "scene.decoder.load_scope", "scene.decoder.expert_init")

    def head(self) -> type[LocalHead]:
        return LocalHead

    def check(self) -> None:
        super().check()
        if not (self.router.input_pos and self.router.bias):
            raise InputError("expected a router with a bias and positions for experts of places, found one without; leave these flags out")
        if self.shared:
            raise InputError("expected no --scene.decoder.shared for experts of places, found it; leave it out")


class LocalHead(MixtureHead):
    """A mixture whose router chooses by the nearest centre. `split` sets its weights; no loss trains them."""

    def __init__(self, config: Experts, *shape: Any) -> None:
        varied = config.expert_init == "variance"  # for means of many outputs; here one network begins alone
        super().__init__(replace(config, expert_init="independent") if varied else config, *shape)
        for parameter in (self.router_w, self.router_b):
            assert parameter is not None
            parameter.requires_grad_(False).zero_()

    def is_whole(self, step: int) -> bool:
        """Whether one network still decodes every anchor at `step`."""
        return step <= self.config.warmup

    def begin(self, before: int, step: int, positions: Callable[[], Tensor], companions: Callable[[Tensor], list[Tensor]]) -> None:
        if before <= self.config.warmup < step:
            self.split(positions(), companions)

    @torch.no_grad()
    def split(self, positions: Tensor, companions: Callable[[Tensor], list[Tensor]]) -> None:
        """Make every expert a copy of the first, and give each its part of the scene.

        positions [N, 3] are divided by the scene's extent. companions(p) returns tensors of a parameter's shape that follow it, such as
        Adam's moments.
        """
        for parameter in (self.w1, self.b1, self.w2, self.b2):
            for tensor in (parameter.data, *companions(parameter)):
                tensor[1:] = tensor[:1].clone()
        if len(positions) == 0:  # no places to divide: the router stays as it is
            return
        centres, spread = find_centres(positions.cpu(), self.experts)
        self.router_w.zero_()
        self.router_w[:, -3:] = (2.0 * centres / spread).to(self.router_w)
        assert self.router_b is not None
        self.router_b.copy_(-centres.square().sum(1) / spread)
        for parameter in (self.router_w, self.router_b):
            for tensor in companions(parameter):  # its average: no moments, as nothing trains it
                tensor.copy_(parameter)

    def route(self, feature: Tensor, step: int, position: Tensor | None, mode: Mode = Mode.DRAW) -> tuple[Routing, Tensor]:
        """Route as `MixtureHead` does. During the warm-up, the gate of expert 0 is 1."""
        if not self.is_whole(step):
            return super().route(feature, step, position, mode)
        gates = feature.new_zeros(len(feature), self.experts)
        gates[:, 0] = 1.0
        return Routing(gates, None), gates

    def forward(
        self, x: Tensor, feature: Tensor, step: int, position: Tensor | None = None, mode: Mode = Mode.DRAW
    ) -> tuple[Tensor, Routing | None]:
        if not self.is_whole(step):
            return super().forward(x, feature, step, position, mode)
        y = self.expert(0, x)
        return (ACTIVATIONS[self.attribute](y) if self.config.mix == "pre_activation" else y), self.routing(feature, step)

    def weights(self, step: int) -> HeadWeights | None:
        if not self.is_whole(step):
            return super().weights(step)
        return HeadWeights(None, None, self.w1[:1], self.b1[:1], self.w2[:1], self.b2[:1], None)


def find_centres(positions: Tensor, count: int) -> tuple[Tensor, float]:
    """Return `count` centres [count, 3] of positions [N, 3] by k-means, and the mean squared distance to the nearest of them.

    The result is float64 and the same on every device and for every number of threads. N must be at least 1.
    """
    x = positions.double()[:: -(-len(positions) // SAMPLE)]
    low, high = x.quantile(MARGIN, dim=0), x.quantile(1.0 - MARGIN, dim=0)
    inner = x[((x >= low) & (x <= high)).all(dim=1)]
    x = inner if len(inner) >= count else x
    centres = _halve(x, count)  # from equal parts, so that no expert gets a few far anchors alone
    nearest = _squares(x, centres).argmin(dim=1)
    for _ in range(ROUNDS):
        members = torch.bincount(nearest, minlength=count)
        sums = torch.zeros_like(centres).index_add_(0, nearest, x)
        centres = torch.where(members[:, None] > 0, sums / members.clamp_min(1)[:, None], centres)
        before, nearest = nearest, _squares(x, centres).argmin(dim=1)
        if torch.equal(before, nearest):
            break
    return centres, float(_squares(x, centres).amin(dim=1).mean().clamp_min(1e-12))


def _halve(x: Tensor, count: int) -> Tensor:
    """Return the means [count, 3] of `count` equal parts of the rows x [n, 3]: halved across the axis of the largest variance, each half
    again, and so on."""
    if count == 1 or len(x) == 1:
        return x.mean(dim=0).expand(count, 3)
    first = count // 2
    order = x[:, int(x.var(dim=0).argmax())].argsort(stable=True)
    cut = min(max(round(len(x) * first / count), 1), len(x) - 1)
    return torch.cat([_halve(x[order[:cut]], first), _halve(x[order[cut:]], count - first)])


def _squares(x: Tensor, centres: Tensor) -> Tensor:
    """Return the squared distances [n, c] of rows x [n, 3] from centres [c, 3]."""
    return torch.stack([(x - centre).square().sum(dim=1) for centre in centres], dim=1)
