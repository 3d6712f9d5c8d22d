"""Learning rates of anchors and of the networks that decode them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from scene_experts.core.fields import Needs, NotNegative, Range, With
from scene_experts.core.parts import register
from scene_experts.core.schedule import Rate
from scene_experts.scene import CODES, ROUTERS, LearningRates
from scene_experts.scene.anchors.mlp import ATTRIBUTES

SHARED = ("mix", "appearance")  # beside the decoder networks, what all anchors share


@register
@dataclass(frozen=True)
class Rates(LearningRates):
    """Learning rates of Scaffold-GS. `offsets` is multiplied by the scene's extent R."""

    family = "anchors"

    feature: Rate = Rate(0.0075, 0.0075)
    """Learning rate of the anchor features."""
    offsets: Rate = Rate(0.01, 0.0001)
    """Learning rate of the offsets, times the scene's extent."""
    log_scaling: Rate = Rate(0.007, 0.007)
    """Learning rate of the anchor sizes."""
    opacity: Rate = Rate(0.002, 0.00002)
    """Learning rate of the opacity network."""
    cov: Rate = Rate(0.004, 0.004)
    """Learning rate of the covariance network."""
    color: Rate = Rate(0.008, 0.00005)
    """Learning rate of the colour network."""
    mix: Rate = Rate(0.01, 0.00001)
    """Learning rate of the network of the feature bank."""
    appearance: Annotated[Rate, Needs(CODES)] = Rate(0.05, 0.0005)
    """Learning rate of the appearance codes."""
    router_scale: Annotated[NotNegative, Needs(ROUTERS)] = 1.0
    """Factor of a router's learning rate over that of its attribute."""
    networks: NotNegative = 1.0
    """Factor of the learning rates of the decoder networks and their routers. 0 also keeps the
    feature bank and the appearance codes."""
    anneal: Annotated[float, Range(above=0, high=1)] = 1.0
    """Final value of the learning rates that are constant otherwise (feature, log_scaling, cov),
    relative to their first; 1 leaves them constant."""
    anneal_from: Annotated[float, Range(0, below=1), With(("anneal",), off=1)] = 2 / 3
    """Share of the training after which these rates fall, log-linearly."""

    def at(self, group: str, step: int, total: int, extent: float) -> float:
        """Return the learning rate of a group of `rate_groups` at `step` of `total`."""
        attribute, _, router = group.partition(".")
        rate: Rate = getattr(self, attribute)
        factor = self.router_scale if router else extent if attribute == "offsets" else 1.0
        value = rate.at(step, total) * factor
        if attribute in ATTRIBUTES and self.networks != 1.0:
            value *= self.networks
        if attribute in SHARED and self.networks == 0:
            return 0.0
        if self.anneal != 1.0 and rate.first == rate.last:
            past = (step / max(total, 1) - self.anneal_from) / (1.0 - self.anneal_from)
            value *= self.anneal ** min(max(past, 0.0), 1.0)
        return value
