"""Load balancing without a loss (Wang et al. 2024, "Auxiliary-loss-free load balancing strategy for
mixture-of-experts").

Each expert has a bias b_i that affects only the choice of experts:
    I = Top-k of g_i + b_i,   w_i = g_i / sum_{j in I} g_j,   then   b_i <- b_i + speed sign(mean_j
    c_j - c_i)
where c_i is the number of anchors in the view that chose expert i. The features get no gradient
from a balancing loss. The alternative is the loss L_load.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated

import torch
from torch import Tensor, nn

from scene_experts.core.fields import PACE, NotNegative
from scene_experts.core.parts import register
from scene_experts.core.types import Mode
from scene_experts.scene.anchors.routers import Linear, LinearModule, top_k


@register
@dataclass(frozen=True)
class Balanced(Linear):
    """A linear router whose experts are balanced by biases."""

    name = "balanced"

    speed: Annotated[NotNegative, PACE] = 0.001
    """Change of a bias per iteration. Gates are between 0 and 1."""

    def build(self, experts: int, feature: int) -> BalancedModule:
        return BalancedModule(experts, feature, self)


class BalancedModule(LinearModule):
    """Chooses experts by biased gates. `balance` [E] has no gradient of a loss: its gradient holds
    how many anchors chose each expert, so that the views of a batch add up in one process and in
    several. `end_batch` moves it."""

    def __init__(self, experts: int, feature: int, config: Balanced) -> None:
        super().__init__(experts, feature, config.input_pos)
        self.speed = config.speed
        self.balance = nn.Parameter(torch.zeros(experts))

    def choose(self, logits: Tensor, k: int, mode: Mode) -> Tensor:
        """Return the indices [A, k] of the largest biased gates, largest first. Training counts
        them."""
        chosen = top_k(logits.softmax(dim=1) + self.balance, k)
        if mode is Mode.TRAIN:
            count = torch.bincount(chosen.reshape(-1), minlength=len(self.balance)).to(self.balance.dtype)
            self.balance.grad = count if self.balance.grad is None else self.balance.grad + count
        return chosen

    @torch.no_grad()
    def end_batch(self, views: int) -> None:
        """Move the biases towards the experts that fewer anchors chose. As a learning rate, the
        speed grows with sqrt(views)."""
        count, self.balance.grad = self.balance.grad, None
        if count is not None:
            self.balance += self.speed * math.sqrt(views) * (count.mean() - count).sign()

    def fused(self) -> None:
        return None
