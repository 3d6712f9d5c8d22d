"""Decoder heads. A head maps an anchor's feature and the viewing direction to K values of one
attribute (as in Scaffold-GS)."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Annotated, Literal, Protocol

import torch
from torch import Tensor, nn
from torch.nn import functional

from scene_experts.core.fields import Range
from scene_experts.core.parts import Part, register
from scene_experts.core.types import Mode, Routing

Attribute = Literal["opacity", "cov", "color"]
ATTRIBUTES: tuple[Attribute, ...] = ("opacity", "cov", "color")  # decoded attributes, in the compiled library's order
ACTIVATIONS: dict[str, Callable[[Tensor], Tensor]] = {"opacity": torch.tanh, "cov": lambda y: y, "color": torch.sigmoid}
"""Activation of the last layer of each attribute."""
CHANNELS = {"opacity": 1, "cov": 7, "color": 3}  # values per Gaussian: opacity; 3 scale + 4 rotation; RGB


@dataclass(frozen=True)
class HeadWeights:
    """The tensors of a head, for kernels and files. A plain network has E = 1 and no router.

    k: number of experts that decode an anchor. None means dense: all, weighted by their gates. A
    head with several experts and no `router_w` is routed outside the kernels, which take the
    mixture weights as an input.
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

    @property
    def routed_outside(self) -> bool:
        """Whether the kernels need the mixture weights of each anchor."""
        return self.router_w is None and len(self.w1) > 1


Outside = Mapping[str, tuple[Routing, Tensor]]
"""Routing and mixture weights ([A, k], or [A, E] while dense) by attribute, for the heads that are
`HeadWeights.routed_outside`."""
NOT_ROUTED: Outside = MappingProxyType({})


class Head(Protocol):
    """Interface of a network that decodes one attribute."""

    experts: int  # number of experts; 0 without a mixture
    in_two_phases: bool  # whether the tensors of `weights` are the same ones up to the end of the dense warm-up, and after it

    def __call__(
        self, x: Tensor, feature: Tensor, step: int, position: Tensor | None = None, mode: Mode = Mode.DRAW
    ) -> tuple[Tensor, Routing | None]:
        """x [A, inputs], feature [A, F], position [A, 3] over the scene's extent -> activated
        outputs [A, out], routing."""
        ...

    def begin(self, before: int, step: int, positions: Callable[[], Tensor], companions: Callable[[Tensor], list[Tensor]]) -> None:
        """Prepare for training iteration `step`, see `Scene.begin_iteration`. positions() are [N,
        3], over the scene's extent."""
        ...

    def weights(self, step: int) -> HeadWeights:
        """Return the tensors used at `step`."""
        ...

    def route(self, feature: Tensor, step: int, position: Tensor | None = None, mode: Mode = Mode.DRAW) -> tuple[Routing, Tensor] | None:
        """Return the routing and the mixture weights [A, k], or [A, E] while dense; None without
        experts. They never depend on the view."""
        ...

    def end_batch(self, views: int) -> None:
        """Learn what no gradient teaches, see `Scene.end_batch`."""
        ...

    def network_parameters(self) -> list[nn.Parameter]:
        """Return the parameters of the networks."""
        ...

    def router_parameters(self) -> list[nn.Parameter]:
        """Return the parameters of the router; empty without one."""
        ...

    def tensors(self) -> dict[str, nn.Parameter]:
        """Return the parameters by their names in files: those of the networks, then those of a
        router (`router_...`)."""
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
    def has(self) -> frozenset[str]:
        """What the networks add to `SceneConfig.has`."""
        return frozenset()

    @abstractmethod
    def build(self, attribute: str, inputs: int, hidden: int, outputs: int, feature: int) -> nn.Module:
        """Build the `Head` of an attribute. It maps inputs [A, inputs] and features [A, feature] to
        outputs [A, outputs]."""


@register
@dataclass(frozen=True)
class Plain(Decoder):
    """One network per attribute, as in Scaffold-GS. `depth` counts linear layers (the paper's
    Figure 7 goes to 6)."""

    depth: Annotated[int, Range(2)] = 2
    """Number of linear layers per network."""

    def build(self, attribute: str, inputs: int, hidden: int, outputs: int, feature: int) -> MLP:
        return MLP(attribute, inputs, hidden, outputs, self.depth)


class MLP(nn.Module):
    """Linear - ReLU - (Linear - ReLU)* - Linear - activation; weights stacked with a leading expert
    axis of 1."""

    w1: nn.Parameter
    b1: nn.Parameter
    middle: nn.ModuleList
    w2: nn.Parameter
    b2: nn.Parameter
    in_two_phases = True

    def __init__(self, attribute: str, inputs: int, hidden: int, outputs: int, depth: int = 2) -> None:
        super().__init__()
        self.experts = 0
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

    def end_batch(self, views: int) -> None:
        """Do nothing: gradients teach a plain network everything."""

    def network_parameters(self) -> list[nn.Parameter]:
        return list(self.parameters())

    def router_parameters(self) -> list[nn.Parameter]:
        return []

    def tensors(self) -> dict[str, nn.Parameter]:
        return dict(self.named_parameters())

    def weights(self, step: int) -> HeadWeights:
        if not self.middle:
            return HeadWeights(None, None, self.w1, self.b1, self.w2, self.b2, None)
        middle_w = torch.stack([layer.weight for layer in self.middle])[None]  # type: ignore[misc]
        middle_b = torch.stack([layer.bias for layer in self.middle])[None]  # type: ignore[misc]
        return HeadWeights(None, None, self.w1, self.b1, self.w2, self.b2, None, middle_w, middle_b)

    def route(self, feature: Tensor, step: int, position: Tensor | None = None, mode: Mode = Mode.DRAW) -> None:
        return None
