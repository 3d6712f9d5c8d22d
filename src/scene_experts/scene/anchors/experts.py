"""The mixture of experts of the paper (section 3.2): router, dense mixture, Top-k mixture, curriculum.

Symbols: A anchors, F feature size, D input size, E experts, k chosen experts. g = softmax(R(f)) (eq. 3) depends only on the feature.
    dense  (eq. 4)  y = sum_i g_i E_i(z)                          for the first `warmup` iterations
    sparse (eq. 5)  y = sum_{i in Top-k} w_i E_i(z),  w_i = g_i / sum_{j in Top-k} g_j, the softmax over the k chosen logits
The load-balancing losses L_load^S and L_load^D (eq. 6, 7) are in `losses.py`.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import ClassVar, Literal, Self

import torch
from torch import Tensor, nn
from torch.nn import functional

from scene_experts.core.errors import InputError, expect_at_least
from scene_experts.core.parts import register
from scene_experts.core.types import Mode, Routing
from scene_experts.scene.anchors.mlp import ACTIVATIONS, ATTRIBUTES, LEAST_MARGIN, MLP, Decoder, HeadWeights, linear_init

log: logging.Logger = logging.getLogger(__name__)
MOST_MARGINS = 64  # experts of a head with margin weights in the compiled library


@dataclass(frozen=True)
class Router:
    """The router, which computes the gates.

    The defaults are the paper's "simple linear layer"; the other values cover what it leaves open.
    """

    bias: bool = True
    """Give the linear layer a bias."""
    init: Literal["default", "zeros"] = "default"
    """Initialisation of the weights: PyTorch's default, or zeros."""
    renormalise: bool = True
    """Scale the weights of the chosen experts to sum to 1 (eq. 5). With k = 1 the router then gets gradients from L_load only."""
    noise_std: float = 0.0
    """Standard deviation of the Gaussian noise on the logits during training."""
    weights: Literal["softmax", "margin"] = "softmax"
    """Weights of the chosen experts. softmax: eq. 5. margin: proportional to a gate minus the largest gate that is not chosen, so that no
    weight jumps where two experts change ranks."""
    detach_feature: bool = False
    """Stop gradients from the gates to the anchor features."""
    input_pos: bool = False
    """Append the anchor's position, divided by the scene's extent, to the router's input (the paper's appendix)."""


@register
@dataclass(frozen=True)
class Experts(Decoder):
    """A mixture of experts for each attribute, with a linear router."""

    num: int = 5
    """Number of experts per attribute."""
    top_k: int | None = 2
    """Number of experts per anchor after the warm-up; none keeps the dense mixture."""
    warmup: int = 1500
    """Iterations with the dense mixture before Top-k. --iterations rescales it."""
    attributes: tuple[str, ...] = ATTRIBUTES
    """Attributes that have experts: opacity, cov, color. The others have one network."""
    mix: Literal["post_activation", "pre_activation"] = "post_activation"
    """Mix the outputs of the experts after or before the activation function."""
    expert_init: Literal["independent", "clone_jitter", "variance"] = "independent"
    """independent: initialise each expert on its own. clone_jitter: copies of one network with small noise. variance: independent, with
    the last layers times sqrt(num), so that the outputs of the dense mixture vary as much as those of one network."""
    load_scope: Literal["visible", "all"] = "visible"
    """Anchors over which L_load balances the experts: the visible ones, or all."""
    shared: bool = False
    """Add an expert that decodes every anchor beside the chosen ones. The router weighs it against them; L_load ignores it."""
    form: Literal["fast", "masked"] = "fast"
    """How PyTorch computes Top-k. fast: gather the anchors of each expert. masked: run all experts and zero the weights of the others (slow
    reference)."""
    router: Router = Router()

    learns_routing: ClassVar[bool] = True
    """Whether losses train the routers."""

    @property
    def with_experts(self) -> tuple[str, ...]:
        return self.attributes

    @property
    def dense_until(self) -> int:
        return self.warmup

    @property
    def balances_all(self) -> bool:
        return self.load_scope == "all"

    def scaled(self, factor: float) -> Self:
        """Return the settings for a training run that is `factor` times as long. The dense warm-up scales with it."""
        return replace(self, warmup=round(self.warmup * factor))

    def check(self) -> None:
        """Raises InputError, naming the flag, for invalid settings."""
        expect_at_least([("--scene.decoder.num", self.num, 1), ("--scene.decoder.warmup", self.warmup, 0)])
        expect_at_least([("--scene.decoder.router.noise-std", self.router.noise_std, 0)])
        if self.top_k is not None and not 1 <= self.top_k <= self.num:
            raise InputError(
                f"expected --scene.decoder.top-k between 1 and the number of experts ({self.num}), found {self.top_k}; "
                "change it or --scene.decoder.num"
            )

    def build(self, attribute: str, inputs: int, hidden: int, outputs: int, feature: int) -> MixtureHead | MLP:
        """Build the head of an attribute: [A, inputs] and features [A, feature] to [A, outputs]. Raises InputError as `check` does."""
        self.check()
        if self.num == 1 or attribute not in self.attributes:
            return MLP(attribute, inputs, hidden, outputs)
        if self.learns_routing and self.top_k == 1 and self.router.renormalise and attribute == self.attributes[0]:
            log.warning("with top_k 1 and renormalised weights the picture does not train the routers; only L_load does")
        return self.head()(self, attribute, inputs, hidden, outputs, feature)

    def head(self) -> type[MixtureHead]:
        """Return the class of the head for attributes with experts. Routing variants override it."""
        return MixtureHead


def top_k(logits: Tensor, k: int) -> Tensor:
    """Return indices [A, k] of the k largest logits [A, E], largest first. Ties go to the lowest index on every device."""
    remaining, chosen = logits.detach(), []
    for _ in range(k):
        best = remaining.argmax(dim=1, keepdim=True)  # the first of equal maxima
        chosen.append(best)
        remaining = remaining.scatter(1, best, -torch.inf)
    return torch.cat(chosen, dim=1)


class MixtureHead(nn.Module):
    """A sparsely gated mixture of E two-layer networks for one attribute."""

    config: Experts
    attribute: str
    experts: int
    batch: int = 1  # views per optimiser step
    w1: nn.Parameter
    b1: nn.Parameter
    w2: nn.Parameter
    b2: nn.Parameter
    router_w: nn.Parameter
    router_b: nn.Parameter | None

    def __init__(self, config: Experts, attribute: str, inputs: int, hidden: int, outputs: int, feature: int) -> None:
        super().__init__()
        self.config, self.attribute = config, attribute
        self.experts = config.num
        E = config.num + config.shared  # the shared expert is the last
        self.w1 = nn.Parameter(torch.cat([linear_init((1, hidden, inputs), inputs).data for _ in range(E)]))
        self.b1 = nn.Parameter(torch.cat([linear_init((1, hidden), inputs).data for _ in range(E)]))
        self.w2 = nn.Parameter(torch.cat([linear_init((1, outputs, hidden), hidden).data for _ in range(E)]))
        self.b2 = nn.Parameter(torch.cat([linear_init((1, outputs), hidden).data for _ in range(E)]))
        if config.expert_init == "clone_jitter":
            for p in (self.w1, self.b1, self.w2, self.b2):
                p.data[1:] = p.data[:1] * (1.0 + 0.01 * torch.randn_like(p.data[1:]))
        if config.expert_init == "variance":  # a mean of E independent outputs has 1 / E of their variance
            self.w2.data.mul_(math.sqrt(E))
            self.b2.data.mul_(math.sqrt(E))
        router_inputs = feature + (3 if config.router.input_pos else 0)
        self.router_w = linear_init((E, router_inputs), router_inputs)
        self.router_b = linear_init((E,), router_inputs) if config.router.bias else None
        if config.router.init == "zeros":
            nn.init.zeros_(self.router_w)
            if self.router_b is not None:
                nn.init.zeros_(self.router_b)

    def begin(self, before: int, step: int, positions: Callable[[], Tensor], companions: Callable[[Tensor], list[Tensor]]) -> None:
        """Prepare for training iteration `step`. The default does nothing. See `Scene.begin_iteration`."""

    def k(self, step: int) -> int | None:
        """Return the number of experts per anchor at `step`, or None if dense. Iterations 1 .. warmup are dense."""
        return None if self.config.top_k is None or step <= self.config.warmup else self.config.top_k

    def logits(self, feature: Tensor, position: Tensor | None, mode: Mode = Mode.DRAW) -> Tensor:
        """Return the router's logits [A, E]. Noise is added in training."""
        router = self.config.router
        x = feature.detach() if router.detach_feature else feature
        if router.input_pos:
            if position is None:
                raise ValueError("expected anchor positions for a router with input_pos, found none")
            x = torch.cat([x, position], dim=1)
        y = functional.linear(x, self.router_w, self.router_b)
        if router.noise_std > 0 and mode is Mode.TRAIN:
            y = y + router.noise_std * torch.randn_like(y)
        return y

    def route(self, feature: Tensor, step: int, position: Tensor | None, mode: Mode = Mode.DRAW) -> tuple[Routing, Tensor]:
        """Return the routing and the mixture weights: [A, E] if dense, [A, k] otherwise."""
        every = self.logits(feature, position, mode)
        logits, k = every[:, : self.experts], self.k(step)
        gates = logits.softmax(dim=1)  # eq. 3
        if k is None:
            return Routing(gates, None), every.softmax(dim=1) if self.config.shared else gates
        chosen = self.choose(logits, k)
        return Routing(gates, chosen), self.weigh(every, gates, chosen)

    def weigh(self, logits: Tensor, gates: Tensor, chosen: Tensor) -> Tensor:
        """Return the weights of the chosen experts [A, k], or [A, k + 1] with the shared expert last. logits [A, E], gates [A, num]."""
        shared = logits[:, self.experts :]  # [A, 1], or [A, 0]
        if self.config.router.weights == "margin":
            rest = gates.scatter(1, chosen, 0.0).amax(dim=1, keepdim=True)
            margin = gates.gather(1, chosen) - rest + LEAST_MARGIN
            weights = margin / margin.sum(dim=1, keepdim=True)
            part = shared.sigmoid()
            return torch.cat([weights * (1.0 - part), part], dim=1) if self.config.shared else weights
        if self.config.router.renormalise:
            return torch.cat([logits.gather(1, chosen), shared], dim=1).softmax(dim=1)  # eq. 5
        return logits.softmax(dim=1).gather(1, self.with_shared(chosen))

    def counts(self) -> list[Tensor]:
        """Return what the head has counted in a batch, as `Scene.counts`. A plain mixture counts nothing."""
        return []

    def settle(self) -> None:
        """Use the counts of a batch, as `Scene.settle`. A plain mixture has none."""

    def with_shared(self, chosen: Tensor) -> Tensor:
        """Append the index of the shared expert, if there is one, to chosen [A, k]."""
        return functional.pad(chosen, (0, 1), value=self.experts) if self.config.shared else chosen

    def choose(self, logits: Tensor, k: int) -> Tensor:
        """Return indices [A, k] of the experts that decode each anchor, given logits [A, E]."""
        return top_k(logits, k)

    def routing(self, feature: Tensor, step: int, position: Tensor | None = None, mode: Mode = Mode.DRAW) -> Routing:
        return self.route(feature, step, position, mode)[0]

    def forward(
        self, x: Tensor, feature: Tensor, step: int, position: Tensor | None = None, mode: Mode = Mode.DRAW
    ) -> tuple[Tensor, Routing | None]:
        """x [A, D], feature [A, F] -> activated mixture [A, out], routing."""
        routing, w = self.route(feature, step, position, mode)
        if routing.chosen is None:
            y = self.all_experts(x, w)
        elif self.config.form == "masked":
            y = self.all_experts(x, self.spread(routing.chosen, w))
        else:
            y = self.chosen_experts(x, self.with_shared(routing.chosen), w)
        return (ACTIVATIONS[self.attribute](y) if self.config.mix == "pre_activation" else y), routing

    def spread(self, chosen: Tensor, w: Tensor) -> Tensor:
        """Return weights [A, E] of all experts, 0 for those that are not chosen. chosen [A, k], w [A, k], or [A, k + 1] if shared."""
        return w.new_zeros(len(w), len(self.w1)).scatter(1, self.with_shared(chosen), w)

    def expert(self, i: int, x: Tensor) -> Tensor:
        """Return one expert's outputs. They are activated unless outputs are mixed before the activation."""
        y = functional.linear(functional.relu(functional.linear(x, self.w1[i], self.b1[i])), self.w2[i], self.b2[i])
        return ACTIVATIONS[self.attribute](y) if self.config.mix == "post_activation" else y

    def all_experts(self, x: Tensor, w: Tensor) -> Tensor:
        """Compute all experts and return sum_i w_i E_i(x). w [A, E]."""
        return sum((w[:, i : i + 1] * self.expert(i, x) for i in range(len(self.w1))), start=x.new_zeros(()))  # type: ignore[return-value]

    def chosen_experts(self, x: Tensor, chosen: Tensor, w: Tensor) -> Tensor:
        """Return the same sum, but compute each expert only for the anchors that chose it, sorted by expert."""
        A, k = chosen.shape
        order = chosen.reshape(-1).argsort(stable=True)
        counts = torch.bincount(chosen.reshape(-1), minlength=len(self.w1)).tolist()
        rows = torch.div(order, k, rounding_mode="floor")
        parts = [self.expert(i, part) for i, part in enumerate(x.index_select(0, rows).split(counts)) if len(part)]
        if not parts:
            return x.new_zeros(A, self.w2.shape[1])
        y = torch.cat(parts) * w.reshape(-1, 1).index_select(0, order)
        return torch.zeros(A, y.shape[1], dtype=y.dtype, device=y.device).index_add(0, rows, y)

    def aligned(
        self, x: Tensor, feature: Tensor, step: int, position: Tensor | None, K: int, mode: Mode = Mode.DRAW
    ) -> tuple[Tensor, Routing]:
        """Return mixed covariance outputs [A, K * 7]. Quaternions are first flipped to the hemisphere of the anchor's first expert."""
        routing, w = self.route(feature, step, position, mode)
        if routing.chosen is not None:
            w = self.spread(routing.chosen, w)
        y = torch.stack([self.expert(i, x) for i in range(len(self.w1))], dim=1).reshape(len(x), len(self.w1), K, 7)
        first = routing.gates.argmax(dim=1)[:, None, None, None].expand(-1, 1, K, 4)
        reference = y[..., 3:].gather(1, first)
        sign = torch.where((y[..., 3:] * reference).sum(-1, keepdim=True) < 0, -1.0, 1.0)
        y = torch.cat([y[..., :3], y[..., 3:] * sign.detach()], dim=-1)
        return (w[:, :, None, None] * y).sum(1).reshape(len(x), K * 7), routing

    def weights(self, step: int) -> HeadWeights | None:
        config, router = self.config, self.config.router
        margin, k = router.weights == "margin", self.k(step)
        if router.noise_std > 0 or router.detach_feature or not (router.renormalise or margin):
            return None
        if margin and (config.shared or self.experts > MOST_MARGINS):
            return None
        tensors = (self.router_w, self.router_b, self.w1, self.b1, self.w2, self.b2)
        return HeadWeights(
            *tensors,
            None if k is None else k + config.shared,
            position=router.input_pos,
            linear=config.mix == "pre_activation",
            shared=config.shared,
            margin=margin,
        )
