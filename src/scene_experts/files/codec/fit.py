"""Fits the models of the groups to a scene's own values, in seconds and the same on every run.

Means begin as weighted least squares. Then mean and spread descend together on the length of the
code in bits, which is that of a logistic distribution (Balle et al. 2018 derive such models; here
they are linear). Weights that save less than they cost become zero.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from scene_experts.core.logistic import find_slopes
from scene_experts.core.threads import one_thread
from scene_experts.files.codec.groups import CLASS, MOST_FACTOR, MOST_OFFSET, SLOTS, UNIT, ChannelGroup, GroupModel, Walk, inputs_of
from scene_experts.files.codec.order import CodingOrder
from scene_experts.files.codec.reference import Ints
from scene_experts.files.codec.streams import as_inputs

ROWS = 32_768  # anchors that a model is fitted to, at most
STEPS, BATCH, RATE = 160, 1024, 0.03
PER_STEP = 4  # anchors for each step, at least: few anchors cannot tell more
PRICE = 8.0  # bits, of each unit of the size of a weight (in deviations); spread over the anchors
_MEAN, _SPREAD = 64.0, 6  # units of a weight of the mean; shift of those of the spread
_OCTAVE = 8 / math.log(2)


def fit_models(groups: Sequence[ChannelGroup], order: CodingOrder, values: Mapping[str, Ints]) -> dict[str, GroupModel]:
    """Models by group of values by group, [C, N] int32 in coding order."""
    channels = {g.name: g.channels for g in groups}
    models = {g.name: blank_model(g, channels, values[g.name], values[CLASS][0]) for g in groups}
    walk = Walk(groups, order, models)
    walk.values = {name: np.ascontiguousarray(value, np.int32) for name, value in values.items()}
    every = max(1, -(-walk.count // ROWS))
    for group in groups:
        classes = walk.classes(group, slice(0, walk.count))
        for c in range(len(walk.columns[group.name])):
            walk.columns[group.name][c] = as_inputs(walk.values[group.name][c], classes, *models[group.name].scaling[c].tolist())
        if not walk.count:
            continue
        parts = []
        for level, places in enumerate(order.levels):
            inputs = walk.inputs(group, level, places)
            if group.is_chain:
                inputs.append(walk.columns[group.name][:, places])
            parts.append(np.concatenate([block[:, ::every] for block in inputs.blocks]))
        rows = np.concatenate([np.arange(places.start, places.stop, every) for places in order.levels])
        live = walk.values[SLOTS][:, rows] != 0 if group.masked else None
        with one_thread():
            models[group.name] = fit_model(
                group, models[group.name], np.concatenate(parts, 1), walk.values[group.name][:, rows], classes[rows], live
            )
    return models


def blank_model(group: ChannelGroup, channels: Mapping[str, int], values: Ints, classes: Ints) -> GroupModel:
    """A model that predicts the same of every anchor, with the scaling of its values [C, N] as
    inputs. channels: of the groups by name; classes: [N]."""
    weights = [np.zeros((2, D), np.int8) for D in inputs_of(group, channels)]
    if group.refines:
        return GroupModel(weights, np.zeros((group.channels, 4), np.int32), np.zeros((0, 2), np.int32))
    value = values.astype(np.float64)
    if group.has_steps:
        value = value * 2.0**classes
    mean, deviation = (value.mean(1), value.std(1)) if value.shape[1] else (np.zeros(len(value)), np.ones(len(value)))
    factor = np.array([_coarse(v, 1, MOST_FACTOR) for v in UNIT * 1024 / np.maximum(deviation, 0.05)])
    offset = np.array([_coarse(v, -MOST_OFFSET, MOST_OFFSET) for v in mean * 4 * factor])
    return GroupModel(weights, np.zeros((group.channels, 4), np.int32), np.stack([factor, offset], 1).astype(np.int32))


def split(value: int) -> tuple[int, int]:
    """A whole number as mantissa and exponent, mantissa 2^exponent, the mantissa within +-255; lower
    bits are rounded away."""
    exponent = max(0, abs(value).bit_length() - 8)
    mantissa = (abs(value) + (1 << exponent >> 1)) >> exponent
    if mantissa > 255:
        mantissa, exponent = mantissa >> 1, exponent + 1
    return (mantissa if value >= 0 else -mantissa), exponent


def _coarse(value: float, low: int, high: int) -> int:
    """A number as its file holds it."""
    mantissa, exponent = split(round(min(max(value, low), high)))
    return min(max(mantissa << exponent if mantissa >= 0 else -(-mantissa << exponent), low), high)


def fit_model(
    group: ChannelGroup,
    blank: GroupModel,
    inputs: NDArray[np.int16],
    values: Ints,
    classes: NDArray[np.int8],
    live: NDArray[np.bool_] | None,
) -> GroupModel:
    """The model of one group. inputs [D, n] of the last channel (and the group's own), values [C,
    n], classes [n], live [slots, n]."""
    X = torch.from_numpy(np.ascontiguousarray(inputs.T, np.float32) / UNIT)
    y, k = torch.from_numpy(np.ascontiguousarray(values.T, np.float32)), torch.from_numpy(classes.astype(np.float32))[:, None]
    n, C = y.shape
    seen = torch.ones(n, C) if live is None else torch.from_numpy(np.repeat(live, group.masked, 0).T.astype(np.float32))
    mask = torch.zeros(C, X.shape[1])
    for c, weights in enumerate(blank.weights):
        mask[c, : weights.shape[1]] = 1
    if group.is_binary:
        spread, bias = _descend_binary(X, y, mask)
        return _whole(blank, torch.zeros_like(spread), torch.zeros(C), spread, bias, mask, binary=True)
    base = y * 2.0**k
    deviation, middle = base.std(0, correction=0) + 1e-2, base.mean(0)
    mean, bias, means = torch.zeros(C, X.shape[1]), torch.zeros(C), group.has_mean
    if means:
        A = torch.cat([torch.ones(n, 1), X], 1).double() * 2.0**-k  # inputs of a channel are the first ones
        square, right = A.T @ A, A.T @ (((base - middle) / deviation).double() * 2.0**-k)
        for c in range(C):
            used = blank.weights[c].shape[1] + 1
            ridge = 1e-3 * n * torch.eye(used, dtype=torch.float64)
            found = torch.linalg.solve(square[:used, :used] + ridge, right[:used, c : c + 1])[:, 0].float()
            mean[c, : used - 1], bias[c] = found[1:], found[0]
    left = ((base - middle) / deviation - X @ mean.T - bias).abs()
    start = torch.log(0.7 * (left * seen).sum(0) / seen.sum(0).clamp_min(1) + 1e-3)
    mean, bias, spread, start = _descend(X, y, k, seen, mask, mean, bias, start, middle, deviation, means)
    return _whole(blank, mean * deviation[:, None], bias * deviation + middle, spread, start + deviation.log(), mask)


def _descend(
    X: Tensor,
    y: Tensor,
    k: Tensor,
    seen: Tensor,
    mask: Tensor,
    mean: Tensor,
    bias: Tensor,
    start: Tensor,
    middle: Tensor,
    deviation: Tensor,
    means: bool,
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Weights and biases of mean and spread (in deviations and natural logarithms) with the
    shortest code."""
    n, spread = len(y), torch.zeros_like(mean)
    adam = _Descent([mean, bias, spread, start], min(STEPS, n // PER_STEP))
    price, log_deviation = PRICE / n, deviation.log()
    for rows in adam.rows(n):
        x, own = X.index_select(0, rows), k.index_select(0, rows)
        weight = seen.index_select(0, rows) / min(BATCH, n)
        factor = 2.0**-own
        m = (middle + deviation * (bias + x @ mean.T)) * factor
        log_scale = start + x @ spread.T + log_deviation - own * math.log(2)
        _, by_away, by_spread = find_slopes(y.index_select(0, rows) - m, log_scale)
        by_mean, by_spread = by_away.mul_(weight).mul_(-deviation * factor), by_spread.mul_(weight)
        moved = means * mask
        adam.move(
            [
                (by_mean.T @ x).mul_(moved).add_(mean.sign(), alpha=price),
                means * by_mean.sum(0),
                (by_spread.T @ x).mul_(mask).add_(spread.sign(), alpha=price),
                by_spread.sum(0),
            ]
        )
    return mean, bias, spread, start


class _Descent:
    """Adam (Kingma and Ba 2015) on a few tensors, in place, with random rows for each step."""

    def __init__(self, tensors: list[Tensor], count: int) -> None:
        self.tensors, self.count, self.step = tensors, count, 0
        self.moments = [(torch.zeros_like(t), torch.zeros_like(t)) for t in tensors]
        self.generator = torch.Generator().manual_seed(0)

    def rows(self, n: int) -> Iterator[Tensor]:
        """Random rows of n for each step."""
        for _ in range(self.count):
            yield torch.randint(0, n, (min(BATCH, n),), generator=self.generator)

    def move(self, gradients: list[Tensor]) -> None:
        """Take a step. The rate falls log-linearly."""
        rate, self.step = RATE * 0.03 ** (self.step / self.count), self.step + 1
        for tensor, gradient, (first, second) in zip(self.tensors, gradients, self.moments):
            first.lerp_(gradient, 0.1)
            second.mul_(0.999).addcmul_(gradient, gradient, value=0.001)
            size = (second.sqrt() / math.sqrt(1 - 0.999**self.step)).add_(1e-8)
            tensor.addcdiv_(first, size, value=-rate / (1 - 0.9**self.step))


def _descend_binary(X: Tensor, y: Tensor, mask: Tensor) -> tuple[Tensor, Tensor]:
    """Weights and biases of the natural logarithm of the odds."""
    n, weights = len(y), torch.zeros_like(mask)
    share = y.mean(0).clamp(0.01, 0.99)
    bias = torch.log(share / (1 - share))
    adam = _Descent([weights, bias], min(STEPS, n // PER_STEP))
    for rows in adam.rows(n):
        x = X[rows]
        slope = ((x @ weights.T + bias).sigmoid_() - y[rows]) / (min(BATCH, n) * math.log(2))
        adam.move([(slope.T @ x).mul_(mask).add_(weights.sign(), alpha=PRICE / n), slope.sum(0)])
    return weights, bias


def _whole(blank: GroupModel, mean: Tensor, mean_bias: Tensor, spread: Tensor, spread_bias: Tensor, mask: Tensor, binary: bool = False) -> GroupModel:  # fmt: skip  # noqa: E501
    """Whole numbers of weights: the mean in steps of the channel, the spread as a natural
    logarithm, both for inputs in deviations."""
    numbers, weights = np.zeros((len(mean), 4), np.int64), []
    even = 32 if binary else 0  # `predict` adds 32, and even odds are 64
    for c, known in enumerate(blank.weights):
        used, rows = known.shape[1], []
        size = float(mean[c].abs().max())
        precise = math.floor(math.log2(_MEAN / max(float(mean[c].square().sum().sqrt()), 1e-6))) if size > 0 else 0
        for at, (w, b, shift, unit) in enumerate(
            (
                (mean[c, :used] * mask[c, :used], mean_bias[c], precise, 32.0),
                (spread[c, :used] * mask[c, :used], spread_bias[c], _SPREAD, _OCTAVE),
            )
        ):
            w = w.double() * unit / UNIT  # outputs per unit of input
            most = float(w.abs().max()) if used else 0.0
            shift = min(shift, math.floor(math.log2(127 / most)) if most > 0 else shift, 16)
            shift = max(shift, -16)
            rows.append((w * 2.0**shift).round().clamp(-127, 127).numpy().astype(np.int8))
            bias = (float(b) * unit + (even if at else 0)) * 2.0**shift
            numbers[c, 2 * at : 2 * at + 2] = _coarse(bias, -(1 << 28), 1 << 28), shift
        weights.append(np.stack(rows))
    return GroupModel(weights, numbers.astype(np.int32), blank.scaling).checked()
