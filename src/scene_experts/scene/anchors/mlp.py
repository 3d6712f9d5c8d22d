"""Decoder heads. A head maps an anchor's feature and the viewing direction to K values of one attribute (as in Scaffold-GS)."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import torch
from torch import Tensor, nn
from torch.nn import functional

from scene_experts.core.errors import InputError, expect_at_least
from scene_experts.core.parts import Part, register
from scene_experts.core.types import Mode, Routing

ATTRIBUTES = ("opacity", "cov", "color")  # decoded attributes, in the compiled library's order
ACTIVATIONS: dict[str, Callable[[Tensor], Tensor]] = {"opacity": torch.tanh, "cov": lambda y: y, "color": torch.sigmoid}
"""Activation of the last layer of each attribute."""
LEAST_MARGIN = 1e-4  # added to margin weights (`Router.weights`), which stay finite where all gates are equal
CHANNELS = {"opacity": 1, "cov": 7, "color": 3}  # values per Gaussian: opacity; 3 scale + 4 rotation; RGB


@dataclass(frozen=True)
class HeadWeights:
    """The tensors of a head, for kernels and files. A plain network has E = 1 and no router.

    E counts the shared expert, which is the last.
    k: number of experts that decode an anchor, the shared one included. None means dense: all, weighted by their gates.
    """

    router_w: Tensor | None  # [E, F], or [E, F + 3] if the router receives the anchor's position
    router_b: Tensor | None  # [E]
    w1: Tensor  # [E, H, D]
    b1: Tensor  # [E, H]
    w2: Tensor  # [E, out, H]
    b2: Tensor  # [E, out]
    k: int | None
    middle_w: Tensor | None = None  # [E, L, H, H]: L hidden layers between the first and the last
    middle_b: Tensor | None = None  # [E, L, H]
    position: bool = False  # the router receives the anchor's position, divided by the scene's extent
    linear: bool = False  # the experts' outputs are mixed before the activation
    shared: bool = False  # the last expert decodes every anchor
    margin: bool = False  # the weights of the chosen experts are margins, see `Router.weights`


class Head(Protocol):
    """Interface of a network that decodes one attribute."""

    experts: int  # number of experts; 0 without a mixture

    def __call__(
        self, x: Tensor, feature: Tensor, step: int, position: Tensor | None = None, mode: Mode = Mode.DRAW
    ) -> tuple[Tensor, Routing | None]:
        """x [A, inputs], feature [A, F], position [A, 3] over the scene's extent -> activated outputs [A, out], routing."""
        ...

    def begin(self, before: int, step: int, positions: Callable[[], Tensor], companions: Callable[[Tensor], list[Tensor]]) -> None:
        """Prepare for training iteration `step`, see `Scene.begin_iteration`. positions() are [N, 3], over the scene's extent."""
        ...

    def weights(self, step: int) -> HeadWeights | None:
        """Return the tensors used at `step`, or None if they do not describe the head completely."""
        ...

    def routing(self, feature: Tensor, step: int, position: Tensor | None = None, mode: Mode = Mode.DRAW) -> Routing | None:
        """Return the routing, or None without experts. It depends only on the anchor's feature, never on the view."""
        ...


def linear_init(shape: tuple[int, ...], fan_in: int) -> nn.Parameter:
    """PyTorch's default for a linear layer's weights and biases: uniform in +-1/sqrt(fan_in)."""
    bound = 1.0 / math.sqrt(fan_in)
    return nn.Parameter(torch.empty(shape).uniform_(-bound, bound))


@dataclass(frozen=True)
class Decoder(Part, ABC):
    """Settings of the networks that decode anchors. Builds one head per attribute."""

    @property
    def with_experts(self) -> tuple[str, ...]:
        """Attributes that have experts."""
        return ()

    @property
    def dense_until(self) -> int:
        """The last iteration of the experts' dense warm-up; 0 without one."""
        return 0

    @property
    def balances_all(self) -> bool:
        """Whether the experts' load is balanced over all anchors instead of the visible ones."""
        return False

    @property
    def unused(self) -> tuple[str, ...]:
        """Settings without an effect on these networks, as `SceneConfig.unused`."""
        return ()

    @abstractmethod
    def build(self, attribute: str, inputs: int, hidden: int, outputs: int, feature: int) -> nn.Module:
        """Build the `Head` of an attribute. It maps inputs [A, inputs] and features [A, feature] to outputs [A, outputs]."""


@register
@dataclass(frozen=True)
class Plain(Decoder):
    """One network per attribute, as in Scaffold-GS. `depth` counts linear layers (the paper's Figure 7 goes to 6)."""

    depth: int = 2
    """Number of linear layers per network."""

    @property
    def unused(self) -> tuple[str, ...]:
        return ("loss.load", "rates.router_scale", "scene.quat_align")

    def check(self) -> None:
        """Raises InputError for a network without a hidden layer."""
        expect_at_least([("--scene.decoder.depth", self.depth, 2)])

    def build(self, attribute: str, inputs: int, hidden: int, outputs: int, feature: int) -> MLP:
        return MLP(attribute, inputs, hidden, outputs, self.depth)


class MLP(nn.Module):
    """Linear - ReLU - (Linear - ReLU)* - Linear - activation; weights stacked with a leading expert axis of 1."""

    w1: nn.Parameter
    b1: nn.Parameter
    middle: nn.ModuleList
    w2: nn.Parameter
    b2: nn.Parameter

    def __init__(self, attribute: str, inputs: int, hidden: int, outputs: int, depth: int = 2) -> None:
        super().__init__()
        self.experts = 0
        if depth < 2:
            raise InputError(f"expected a depth of at least 2 linear layers, found {depth}; give a larger number")
        self.attribute = attribute
        self.w1 = linear_init((1, hidden, inputs), inputs)
        self.b1 = linear_init((1, hidden), inputs)
        self.middle = nn.ModuleList(nn.Linear(hidden, hidden) for _ in range(depth - 2))
        self.w2 = linear_init((1, outputs, hidden), hidden)
        self.b2 = linear_init((1, outputs), hidden)

    def forward(
        self, x: Tensor, feature: Tensor, step: int, position: Tensor | None = None, mode: Mode = Mode.DRAW
    ) -> tuple[Tensor, Routing | None]:
        """x [A, D] -> activated outputs [A, out]; no routing."""
        h = functional.relu(functional.linear(x, self.w1[0], self.b1[0]))
        for layer in self.middle:
            h = functional.relu(layer(h))
        return ACTIVATIONS[self.attribute](functional.linear(h, self.w2[0], self.b2[0])), None

    def begin(self, before: int, step: int, positions: Callable[[], Tensor], companions: Callable[[Tensor], list[Tensor]]) -> None:
        """Do nothing: a plain network is the same at every iteration."""

    def weights(self, step: int) -> HeadWeights | None:
        if not self.middle:
            return HeadWeights(None, None, self.w1, self.b1, self.w2, self.b2, None)
        middle_w = torch.stack([layer.weight for layer in self.middle])[None]  # type: ignore[misc]
        middle_b = torch.stack([layer.bias for layer in self.middle])[None]  # type: ignore[misc]
        return HeadWeights(None, None, self.w1, self.b1, self.w2, self.b2, None, middle_w, middle_b)

    def routing(self, feature: Tensor, step: int, position: Tensor | None = None, mode: Mode = Mode.DRAW) -> Routing | None:
        return None
