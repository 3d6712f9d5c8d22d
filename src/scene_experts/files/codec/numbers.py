"""Models and networks as streams of whole numbers."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from scene_experts.core.reading.budget import Damaged
from scene_experts.files.codec.fit import split
from scene_experts.files.codec.groups import ChannelGroup, GroupModel, inputs_of
from scene_experts.files.codec.reference import TOP, Ints
from scene_experts.files.codec.streams import SymbolReader, SymbolWriter

MANTISSA, STEP = 80, 24
"""Spreads, as scales of the coder: 64 for mantissas, 1/2 for differences of small numbers."""
MOST_EXPONENT = 30


class Coding(Protocol):
    """Writes values or reads them, by the same calls."""

    def __call__(self, values: Ints | None, count: int, scale: int | Ints) -> Ints:
        """The values [count], expected around 0 with the spread of `scale` (for all, or [count]).
        Writers take them from `values`."""
        ...


def writing(writer: SymbolWriter) -> Coding:
    """A coding that writes."""

    def code(values: Ints | None, count: int, scale: int | Ints) -> Ints:
        assert values is not None and len(values) == count
        writer.symbols(values, np.zeros(count, np.int32), np.broadcast_to(np.int32(scale), count))
        return values

    return code


def reading(reader: SymbolReader) -> Coding:
    """A coding that reads."""
    return lambda values, count, scale: reader.symbols(np.zeros(count, np.int32), np.broadcast_to(np.int32(scale), count))


def scale_of(values: NDArray[np.int32] | NDArray[np.int64]) -> int:
    """The scale of the logistic distribution around 0 with the mean size of values."""
    mean = float(np.abs(values).mean()) if values.size else 0.0
    return min(TOP, max(0, round(8 * math.log2(max(mean, 0.05) / (2 * math.log(2))) + 32)))


def _differences(code: Coding, values: Ints | None, count: int, low: int, high: int) -> Ints:
    """Code numbers as differences from one to the next, the first from 0. Raises Damaged for
    numbers beyond `low` and `high`."""
    found = code(None if values is None else np.diff(values, prepend=np.int32(0)).astype(np.int32), count, STEP)
    out = np.cumsum(found.astype(np.int64)) if values is None else values.astype(np.int64)
    if count and not low <= out.min() <= out.max() <= high:
        raise Damaged("numbers out of range")
    return out.astype(np.int32)


# --- models -------------------------------------------------------------------------------------------------------------------------------


def code_models(code: Coding, groups: Sequence[ChannelGroup], models: Mapping[str, GroupModel] | None) -> dict[str, GroupModel]:
    """Code the models of groups. models: None reads."""
    channels = {g.name: g.channels for g in groups}
    return {g.name: _code_model(code, g, inputs_of(g, channels), None if models is None else models[g.name]) for g in groups}


def _code_model(code: Coding, group: ChannelGroup, inputs: list[int], model: GroupModel | None) -> GroupModel:
    C = group.channels
    known = [None] * 6 if model is None else [*model.numbers.T, *model.scaling.T]
    biases = [_code_coarse(code, known[i], C) for i in (0, 2)]
    shifts = [_differences(code, known[i], C, -24, 24) for i in (1, 3)]
    scaling = [_code_coarse(code, known[i], 0 if group.refines else C) for i in (4, 5)]
    numbers = np.stack([biases[0], shifts[0], biases[1], shifts[1]], 1)
    scales = None if model is None else np.array([[scale_of(row) for row in rows] for rows in model.weights], np.int32)
    scale = np.stack([_differences(code, None if scales is None else scales[:, i], C, 0, TOP) for i in (0, 1)], 1)
    flat = None if model is None else np.concatenate([rows.ravel() for rows in model.weights]).astype(np.int32)
    found = code(flat, 2 * sum(inputs), np.repeat(scale.ravel(), np.repeat(inputs, 2)).astype(np.int32))
    if np.abs(found.astype(np.int64)).max(initial=0) > 127:
        raise Damaged("a weight out of range")
    ends = np.cumsum(2 * np.array(inputs))
    weights = [found[end - 2 * D : end].astype(np.int8).reshape(2, D) for end, D in zip(ends, inputs)]
    return GroupModel(weights, numbers, np.stack(scaling, 1)).checked()


def _code_coarse(code: Coding, values: Ints | None, count: int) -> Ints:
    """Code numbers that `fit.split` splits without a rest."""
    parts = None if values is None else np.array([split(int(v)) for v in values], np.int32).reshape(count, 2)
    mantissas = code(None if parts is None else parts[:, 0].copy(), count, MANTISSA)
    exponents = _differences(code, None if parts is None else parts[:, 1], count, 0, MOST_EXPONENT)
    found = mantissas.astype(np.int64) * (np.int64(1) << exponents.astype(np.int64))
    if np.abs(found).max(initial=0) > 1 << 30:
        raise Damaged("numbers out of range")
    return found.astype(np.int32)


# --- networks -----------------------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Rounded:
    """A tensor of E experts as whole numbers: value = values 2^(exponent / 2)."""

    values: NDArray[np.int32]
    """[E, R, C]"""
    exponents: Ints
    """[R], of all experts' row r"""

    def floats(self) -> NDArray[np.float32]:
        """The values [E, R, C]."""
        return (self.values * 2.0 ** (self.exponents[:, None] / 2)).astype(np.float32)


def code_rounded(code: Coding, shape: tuple[int, int, int], tensor: Rounded | None) -> Rounded:
    """Code a tensor: the rounded mean of its experts, and what each of them differs by. tensor:
    None reads."""
    E, R, C = shape
    exponents = _differences(code, None if tensor is None else tensor.exponents, R, -120, 120)
    mean = None if tensor is None else np.rint(tensor.values.mean(0)).astype(np.int32)
    shared = _code_rows(code, None if mean is None else mean[None], (1, R, C))
    if E == 1:
        return Rounded(shared, exponents)
    away = None if tensor is None else tensor.values - shared
    out = _code_rows(code, away, shape).astype(np.int64) + shared
    if np.abs(out).max(initial=0) > 1 << 30:
        raise Damaged("a weight out of range")
    return Rounded(out.astype(np.int32), exponents)


def _code_rows(code: Coding, values: NDArray[np.int32] | None, shape: tuple[int, int, int]) -> NDArray[np.int32]:
    """Code numbers [E, R, C] with one spread for each row."""
    E, R, C = shape
    scales = None if values is None else np.array([scale_of(values[:, r]) for r in range(R)], np.int32)
    found = _differences(code, scales, R, 0, TOP)
    spread = np.broadcast_to(found[None, :, None], shape).reshape(-1)
    return code(None if values is None else values.reshape(-1), E * R * C, spread.astype(np.int32)).reshape(shape)
