"""Load balancing without a loss (Wang et al. 2024, "Auxiliary-loss-free load balancing strategy for mixture-of-experts").

Each expert has a bias b_i that affects only the choice of experts:
    I = Top-k of g_i + b_i,   w_i = g_i / sum_{j in I} g_j,   then   b_i <- b_i + speed sign(mean_j c_j - c_i)
where c_i is the number of anchors in the view that chose expert i. The features get no gradient from a balancing loss. The alternative
is the loss L_load.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor, nn

from scene_experts.core.errors import InputError, expect_at_least
from scene_experts.core.parts import register
from scene_experts.core.types import Mode, Routing
from scene_experts.scene.anchors.experts import Experts, MixtureHead, top_k


@register
@dataclass(frozen=True)
class BalancedExperts(Experts):
    """A mixture of experts balanced by biases."""

    speed: float = 0.001
    """Change of a bias per iteration. Gates are between 0 and 1."""

    def head(self) -> type[BalancedHead]:
        return BalancedHead

    def check(self) -> None:
        super().check()
        expect_at_least([("--scene.decoder.speed", self.speed, 0)])
        if self.router.weights == "margin":  # a bias may choose an expert of a smaller gate than the others': its margin is below 0
            raise InputError("expected --scene.decoder.router.weights softmax for experts balanced by biases, found margin; leave it out")


class BalancedHead(MixtureHead):
    """A mixture that chooses experts by biased gates. The optimiser does not update `router_balance` [E]; every training view does."""

    config: BalancedExperts  # type: ignore[assignment]
    router_balance: Tensor
    counted: Tensor

    def __init__(self, config: BalancedExperts, *shape: Any) -> None:
        super().__init__(config, *shape)
        self.router_balance = nn.Parameter(torch.zeros(config.num), requires_grad=False)
        self.moved_at: int | None = None
        # how many anchors chose each expert, over the views of a batch
        self.register_buffer("counted", torch.zeros(config.num), persistent=False)

    def choose(self, logits: Tensor, k: int) -> Tensor:
        """Return the indices [A, k] of the largest biased gates, largest first."""
        return top_k(logits.softmax(dim=1) + self.router_balance, k)

    def route(self, feature: Tensor, step: int, position: Tensor | None, mode: Mode = Mode.DRAW) -> tuple[Routing, Tensor]:
        """Route as `MixtureHead` does. In training, also update the biases once per view, or count for `settle`."""
        routing, w = super().route(feature, step, position, mode)
        if mode is Mode.TRAIN and routing.chosen is not None and step != self.moved_at:
            count = torch.bincount(routing.chosen.reshape(-1), minlength=self.config.num).to(w.dtype)
            self.moved_at = step  # a loss over the whole scene calls `route` a second time
            if self.batch == 1:
                self.move(count, self.config.speed)
            else:
                self.counted += count
        return routing, w

    def move(self, count: Tensor, speed: float) -> None:
        """Move the biases towards the experts that fewer anchors chose. count: [E]."""
        self.router_balance += speed * (count.mean() - count).sign()

    def counts(self) -> list[Tensor]:
        return [self.counted]

    def settle(self) -> None:
        """Update the biases once for a batch, by the counts of all its views. Like a learning rate, the speed grows with sqrt(batch)."""
        self.move(self.counted, self.config.speed * math.sqrt(self.batch))
        self.counted.zero_()

    def weights(self, step: int) -> None:
        """Return None: the kernels choose experts by unbiased gates, so the composed form decodes."""
