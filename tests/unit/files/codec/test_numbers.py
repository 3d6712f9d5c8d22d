"""Models and networks as streams of numbers."""

import numpy as np
import pytest

from scene_experts.core.reading.budget import Damaged
from scene_experts.files.codec.groups import GroupModel, anchor_groups, inputs_of
from scene_experts.files.codec.numbers import Rounded, code_models, code_rounded, reading, scale_of, writing
from scene_experts.files.codec.streams import SymbolReader, SymbolWriter


def test_models_come_back():
    rng = np.random.default_rng(2)
    groups = anchor_groups(4, 2)
    channels, models = {g.name: g.channels for g in groups}, {}
    for g in groups:
        C = g.channels
        numbers = np.stack([rng.integers(-200, 200, C) << 9, rng.integers(-9, 9, C), rng.integers(-90, 90, C), np.full(C, 6)], 1)
        scaling = np.stack([rng.integers(1, 255, C), rng.integers(-250, 250, C) << 15], 1)
        weights = [rng.integers(-127, 128, (2, D)).astype(np.int8) for D in inputs_of(g, channels)]
        models[g.name] = GroupModel(weights, numbers.astype(np.int32), scaling.astype(np.int32))
    writer = SymbolWriter()
    code_models(writing(writer), groups, models)
    reader = SymbolReader(writer.pack())
    found = code_models(reading(reader), groups, None)
    reader.finish()
    for name, model in models.items():
        assert np.array_equal(found[name].numbers, model.numbers) and np.array_equal(found[name].scaling, model.scaling)
        assert all(np.array_equal(a, b) for a, b in zip(found[name].weights, model.weights))


@pytest.mark.parametrize("shape", [(1, 3, 4), (5, 3, 40), (2, 1, 1)])
def test_networks_come_back_and_equal_experts_cost_little(shape):
    rng = np.random.default_rng(0)
    shared = rng.integers(-300, 300, shape[1:])
    tensor = Rounded((shared + rng.integers(-1, 2, shape)).astype(np.int32), rng.integers(-20, 20, shape[1]).astype(np.int32))
    writer = SymbolWriter()
    code_rounded(writing(writer), shape, tensor)
    reader = SymbolReader(writer.pack())
    found = code_rounded(reading(reader), shape, None)
    reader.finish()
    assert np.array_equal(found.values, tensor.values) and np.array_equal(found.exponents, tensor.exponents)
    assert np.array_equal(found.floats(), (tensor.values * 2.0 ** (tensor.exponents[:, None] / 2)).astype(np.float32))
    if shape[0] == 5:
        assert writer.ideal_bits < shared.size * (11 + 5 * 2.5)


def test_numbers_out_of_range_are_refused():
    writer = SymbolWriter()
    writer.symbols(np.array([500], np.int32), np.zeros(1, np.int32), np.full(1, 24, np.int32))
    with pytest.raises(Damaged):
        code_rounded(reading(SymbolReader(writer.pack())), (1, 1, 1), None)


def test_the_scale_of_a_distribution():
    rng = np.random.default_rng(0)
    for scale in (20, 32, 56):
        values = np.rint(rng.logistic(size=20_000) * 2 ** (scale / 8 - 4)).astype(np.int64)
        assert abs(scale_of(values) - scale) <= 2
    assert scale_of(np.zeros(0, np.int64)) >= 0
