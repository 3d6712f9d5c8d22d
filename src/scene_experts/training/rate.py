"""Rate in training: bits of a compact file as a term of the loss (--rate).

The loss of a step is L + rate * B / P. B is the mean number of bits of an anchor's values under a
model that is learned beside the scene, and P the number of values of an anchor. The model is that
of compact files (`files.codec`) in floating point: a value has a logistic distribution whose mean
and spread are linear in the class of the anchor and in its values that are coded before (Balle et
al. 2018; HAC, Chen et al. 2024, learns such models with a scene). A random share of the anchors
stands for all; uniform noise stands for the rounding. Masks see the mean price of a slot and of an
anchor at every step.
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Mapping

import torch
from torch import Tensor, nn
from torch.nn import functional

from scene_experts.core.errors import RunError
from scene_experts.core.logistic import logistic_bits
from scene_experts.core.schedule import Rate, passes
from scene_experts.core.threads import one_thread
from scene_experts.scene import Scene
from scene_experts.scene.anchors.quantise import HIGH_CLASS, KEEP, LOW_CLASS, ROUNDED, STEPS, RowRounding, channels, find_steps, price_masks
from scene_experts.strategy import Strategy

MODEL = "rate"  # name of the learning rate of the model, and of its tensors in a checkpoint
RATES = {KEEP: Rate(0.02, 0.002), STEPS: Rate(0.005, 0.0005), MODEL: Rate(0.01, 0.001)}
"""Learning rates of masks, logarithms of steps and the model, from the start of the rate to the
end."""
SHARE, LEAST = 0.06, 256  # of the anchors that a step looks at; and at least so many
EVERY = 250  # iterations from one removal of closed anchors to the next
ERROR_PER_LOSS = 1 / 66
"""Mean square error for a unit of the loss, about, of pictures with 35 dB; for the first steps."""
CLASSES = HIGH_CLASS - LOW_CLASS + 1


def first_iteration(growth: Strategy, iterations: int) -> int:
    """Return the iteration after which the rate counts: the last one that may add rows, or half of
    the training if that is later or growth adds none."""
    half = iterations // 2
    last = next((step for step in range(iterations, 0, -1) if growth.adds(step)), 0)
    return last if 0 < last <= half else half


class RateModel(nn.Module):
    """The distribution of each of P = F + 6 + 3 K values of an anchor: features, log-scalings,
    offsets, in this order. Means and spreads are in units of the scene."""

    weights: nn.Parameter  # [2, P, D]: of the means and of the natural logarithms of the spreads
    biases: nn.Parameter  # [2, P]
    middle: Tensor  # [P], and `deviation` [P]: of the values when the rate began
    deviation: Tensor
    used: Tensor  # [2, P, D]: 1 where a weight is used
    varies: Tensor  # [2, P]: 1 where a bias is

    def __init__(self, F: int, K: int) -> None:
        super().__init__()
        self.F, P, D = F, channels(F, K), CLASSES + F + 6
        self.weights, self.biases = nn.Parameter(torch.zeros(2, P, D)), nn.Parameter(torch.zeros(2, P))
        used, varies = torch.zeros(2, P, D), torch.ones(2, P)
        used[:, :, :CLASSES] = 1
        for c in range(P):
            used[:, c, CLASSES : CLASSES + min(c, F + 6)] = 1
        used[0, F + 6 :] = varies[0, F + 6 :] = 0  # nothing predicts the mean of an offset
        for name, value in (("middle", torch.zeros(P)), ("deviation", torch.ones(P)), ("used", used), ("varies", varies)):
            self.register_buffer(name, value)

    @torch.no_grad()
    def start(self, values: Tensor) -> None:
        """Begin with the mean and deviation of values [N, P], alike for all anchors."""
        self.middle.copy_(values.mean(0))
        self.deviation.copy_(values.std(0, correction=0) + 1e-6)
        self.biases[1].fill_(math.log(0.55))  # spread of a logistic distribution of deviation 1

    def forward(self, values: Tensor, log_steps: Tensor, classes: Tensor, noise: Tensor) -> Tensor:
        """Return the bits [n, P] of values [n, P] whose steps have the logarithms [n, P]. classes
        [n]; noise [n, P] within half a step. Values that predict others have no gradient by it."""
        steps, known = log_steps.exp(), self.F + 6
        with torch.no_grad():
            rounded = torch.round(values[:, :known] / steps[:, :known]) * steps[:, :known]
            own = (rounded - self.middle[:known]) / self.deviation[:known]
            x = torch.cat([functional.one_hot(classes - LOW_CLASS, CLASSES).to(own.dtype), own], 1)
        mean, spread = (torch.einsum("nd,spd->snp", x, self.weights * self.used) + (self.biases * self.varies)[:, None]).unbind(0)
        away = (values - self.middle - self.deviation * mean) / steps + noise
        return logistic_bits(away, spread + self.deviation.log() - log_steps)


class RateTerm:
    """The rate of one training. The loop calls `begin` once, then `add_gradients` and `drop_closed`
    at every step."""

    def __init__(self, weight: float, seed: int, growth: Strategy, iterations: int) -> None:
        """weight: the setting --rate, above 0."""
        self.weight, self.seed, self.iterations = weight, seed, iterations
        self.first = first_iteration(growth, iterations)
        self.model: RateModel | None = None

    def is_due(self, step: int) -> bool:
        """Whether the rate begins with the iteration `step`, or has been missed."""
        return self.model is None and step > self.first

    def begin(self, scene: Scene, sensitivity: Mapping[str, Tensor], scale: float) -> dict[str, list[nn.Parameter]]:
        """Round the values of a scene from now on. Returns the new parameters by the names of their
        learning rates. sensitivity: of the columns, `find_sensitivity`; scale: of the world."""
        with one_thread():
            steps, classes = find_steps({name: value.detach().cpu() for name, value in sensitivity.items()})
        flat = torch.cat([steps[name] for name in ROUNDED])
        error = self.weight * ERROR_PER_LOSS / (len(flat) * math.log(2) * max(len(classes), 1))  # where a bit costs what it saves
        scene.start_rounding(flat * error**0.5, classes, scale)
        parameters = self.prepare(scene)
        assert self.model is not None
        with one_thread():
            self.model.start(values_of(scene))
        return parameters

    def prepare(self, scene: Scene) -> dict[str, list[nn.Parameter]]:
        """Build the model of a scene that is rounded. Returns as `begin`."""
        params = scene.table.params
        self.model = RateModel(params["feature"].shape[1], scene.K).to(scene.table.device)
        groups = scene.rate_groups()
        return {KEEP: groups[KEEP], STEPS: groups[STEPS], MODEL: [self.model.weights, self.model.biases]}

    def tensors(self, scene: Scene) -> dict[str, Tensor]:
        """Return the state by name in checkpoints; empty before the rate begins."""
        if self.model is None:
            return {}
        return {f"{MODEL}.{name}": value for name, value in self.model.state_dict().items()} | {f"{MODEL}.{STEPS}": _steps(scene).detach()}

    @torch.no_grad()
    def restore(self, scene: Scene, tensors: Mapping[str, Tensor]) -> None:
        """Take the state of a checkpoint, after `prepare`."""
        assert self.model is not None
        for name, value in self.tensors(scene).items():
            value.copy_(tensors[name])

    def learning_rate(self, group: str, step: int) -> float | None:
        """Return the learning rate of a group of `begin` at `step`; None for other groups."""
        return RATES[group].at(step - self.first, self.iterations - self.first) if group in RATES else None

    def add_gradients(self, scene: Scene, step: int) -> Tensor:
        """Add the gradients of weight * B / P to those of the parameters. Returns that term."""
        with one_thread():
            return self._add_gradients(scene, step)

    def _add_gradients(self, scene: Scene, step: int) -> Tensor:
        rounding, model = scene.rounding, self.model
        assert rounding is not None and model is not None
        N, P = len(scene.table), len(rounding.log_steps)
        generator = torch.Generator().manual_seed(_seed(self.seed, step))
        rows = torch.randperm(N, generator=generator)[: max(LEAST, int(SHARE * N))]
        noise = (torch.rand(len(rows), P, generator=generator) - 0.5).to(rounding.log_steps)
        rows = rows.to(scene.table.device)
        values = values_of(scene, rows).requires_grad_()
        with torch.enable_grad():
            bits = self._bits(rounding, model, rows, values, noise)
            term = bits.sum() * (self.weight / (P * max(len(rows), 1)))
            term.backward()
        assert values.grad is not None
        at = 0
        for name in ROUNDED:
            column = scene.table.params[name]
            width = column[:1].numel()
            part = values.grad[:, at : at + width].reshape(len(rows), *column.shape[1:])
            column.grad = torch.zeros_like(column) if column.grad is None else column.grad
            column.grad.index_add_(0, rows, part)
            at += width
        with torch.no_grad():
            price = price_masks(rounding.keep, *self._prices(rounding, rows, bits)) * (self.weight / (P * max(N, 1)))
            keep = scene.table.params[KEEP]
            keep.grad = price if keep.grad is None else keep.grad + price
        return term.detach()

    def _bits(self, rounding: RowRounding, model: RateModel, rows: Tensor, values: Tensor, noise: Tensor) -> Tensor:
        """The bits [n, P] of rows [n], 0 for values that no file holds."""
        classes, opened = rounding.classes.index_select(0, rows), rounding.open.index_select(0, rows)
        log_steps = rounding.log_steps + classes[:, None] * math.log(2)
        held = torch.cat([opened.any(1, keepdim=True).expand(-1, model.F + 6), opened.repeat_interleave(3, 1)], 1)
        return model(values, log_steps, classes, noise) * held

    def _prices(self, rounding: RowRounding, rows: Tensor, bits: Tensor) -> tuple[float, float]:
        """The mean bits of an open slot, and of the other values of an anchor with one."""
        opened, own = rounding.open.index_select(0, rows), len(rounding.log_steps) - 3 * rounding.keep.shape[1]
        slots, anchors = max(int(opened.sum()), 1), max(int(opened.any(1).sum()), 1)
        return float(bits[:, own:].sum()) / slots, float(bits[:, :own].sum()) / anchors

    def drops(self, step: int, views: int) -> bool:
        """Return whether closed anchors are removed at the end of the iteration."""
        return passes(step, views, EVERY)

    def drop_closed(self, scene: Scene, step: int, views: int) -> int:
        """Remove the anchors without an open slot, every 250 iterations. Returns their number.
        Raises RunError if none would be left."""
        if not self.drops(step, views):
            return 0
        closed = ~(scene.table.params[KEEP].detach() > 0).any(1)
        if bool(closed.all()):
            raise RunError(f"expected a --rate that leaves anchors to draw, found {self.weight:g}, which closes all; give a smaller one")
        return scene.table.drop(closed)


def values_of(scene: Scene, rows: Tensor | None = None) -> Tensor:
    """Return the values [n, F + 6 + 3 K] of rows [n], or of all, as they are learned."""
    columns = [scene.table.params[name].detach() for name in ROUNDED]
    return torch.cat([(c if rows is None else c.index_select(0, rows)).flatten(1) for c in columns], 1)


def _steps(scene: Scene) -> Tensor:
    return scene.rate_groups()[STEPS][0]


def _seed(seed: int, step: int) -> int:
    return int.from_bytes(hashlib.blake2b(f"rate {seed} {step}".encode(), digest_size=8).digest(), "little") >> 1
