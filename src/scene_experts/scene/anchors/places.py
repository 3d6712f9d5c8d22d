"""Experts for places: one network per attribute learns first; then each part of the scene goes on
with its own copy of it.

For iterations 1 .. warmup, expert 0 decodes every anchor. Then all experts become copies of it,
with its Adam moments (sparse upcycling, Komatsuzaki et al. 2023), so the picture does not change.
From then on an anchor at x is decoded by the expert of the nearest centre:
    I = argmin_i |x - c_i|^2 = argmax_i (2 c_i x - |c_i|^2) / s
The centres c_i are those of k-means over the anchors' positions, divided by the scene's extent, and
s is the mean squared distance to the nearest of them. A linear router computes this with weights
that are not trained. Anchors do not move, so no anchor ever changes its expert, and none needs a
balancing loss.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor, nn

from scene_experts.core.parts import register
from scene_experts.core.types import Mode, Routing
from scene_experts.scene.anchors.routers import Companions, LinearModule, Router

SAMPLE = 20_000  # positions that k-means looks at
ROUNDS = 100  # of k-means at most
MARGIN = 0.02  # share of the positions that k-means ignores at either end of each axis: far background


@register
@dataclass(frozen=True)
class Places(Router):
    """The experts of the nearest places decode an anchor; expert 0 decodes all of them during the
    warm-up."""

    name = "places"
    learns = False

    def build(self, experts: int, feature: int) -> PlacesModule:
        return PlacesModule(experts, feature)


class PlacesModule(LinearModule):
    """A linear router that sees positions. `begin` sets its weights as the warm-up ends; no loss
    trains them."""

    def __init__(self, experts: int, feature: int) -> None:
        super().__init__(experts, feature, input_pos=True)
        for parameter in (self.w, self.b):
            parameter.requires_grad_(False).zero_()

    def alone(self, k: int | None) -> int | None:
        return 0 if k is None else None

    def begin(
        self, networks: nn.Module, before: int, step: int, warmup: int, positions: Callable[[], Tensor], companions: Companions
    ) -> None:
        if before <= warmup < step:
            self.split(networks, positions(), companions)

    @torch.no_grad()
    def split(self, networks: nn.Module, positions: Tensor, companions: Companions) -> None:
        """Make every expert a copy of the first, and give each its part of the scene.

        positions [N, 3] are divided by the scene's extent.
        """
        for parameter in networks.parameters():
            for tensor in (parameter.data, *companions(parameter)):
                tensor[1:] = tensor[:1].clone()
        if len(positions) == 0:  # no places to divide: the router stays as it is
            return
        centres, spread = find_centres(positions.cpu(), len(self.b))
        self.w.zero_()
        self.w[:, -3:] = (2.0 * centres / spread).to(self.w)
        self.b.copy_(-centres.square().sum(1) / spread)
        for parameter in (self.w, self.b):
            for tensor in companions(parameter):  # its average: no moments, as nothing trains it
                tensor.copy_(parameter)

    def forward(self, feature: Tensor, position: Tensor | None, k: int | None, mode: Mode = Mode.DRAW) -> tuple[Routing, Tensor]:
        """Route as a linear router does. During the warm-up, the gate of expert 0 is 1."""
        if k is not None:
            return super().forward(feature, position, k, mode)
        gates = feature.new_zeros(len(feature), len(self.b))
        gates[:, 0] = 1.0
        return Routing(gates, None), gates


def find_centres(positions: Tensor, count: int) -> tuple[Tensor, float]:
    """Return `count` centres [count, 3] of positions [N, 3] by k-means, and the mean squared
    distance to the nearest of them.

    The result is float64 and the same on every device and for every number of threads. N must be at
    least 1.
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
    """Return the means [count, 3] of `count` equal parts of the rows x [n, 3]: halved across the
    axis of the largest variance, each half again, and so on."""
    if count == 1 or len(x) == 1:
        return x.mean(dim=0).expand(count, 3)
    first = count // 2
    order = x[:, int(x.var(dim=0).argmax())].argsort(stable=True)
    cut = min(max(round(len(x) * first / count), 1), len(x) - 1)
    return torch.cat([_halve(x[order[:cut]], first), _halve(x[order[cut:]], count - first)])


def _squares(x: Tensor, centres: Tensor) -> Tensor:
    """Return the squared distances [n, c] of rows x [n, 3] from centres [c, 3]."""
    return torch.stack([(x - centre).square().sum(dim=1) for centre in centres], dim=1)
