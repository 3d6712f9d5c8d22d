"""The walk: what it writes it reads, with any models, and slowly too."""

import numpy as np
import pytest

from scene_experts.core.reading.budget import Damaged
from scene_experts.files.codec import groups
from scene_experts.files.codec.groups import GroupModel, Walk, anchor_groups, inputs_of
from scene_experts.files.codec.order import CodingOrder
from scene_experts.files.formats.morton import morton

F, K, N = 5, 2, 60


def parts(extra=1, slots=True):
    rng = np.random.default_rng(1)
    found = anchor_groups(F, K, slots, extra)
    channels = {g.name: g.channels for g in found}
    models, values = {}, {}
    for g in found:
        weights = [rng.integers(-127, 128, (2, D)).astype(np.int8) for D in inputs_of(g, channels)]
        numbers = np.stack([rng.integers(-99, 99, g.channels), rng.integers(0, 9, g.channels)] * 2, 1).astype(np.int32)
        models[g.name] = GroupModel(weights, numbers, np.full((g.channels, 2), 900, np.int32)).checked()
        values[g.name] = rng.integers(-60, 60, (g.channels, N)).astype(np.int32)
    values["class"] = values["class"] % 7 - 2
    values["slots"] = values["slots"] % 2
    values["offsets"] *= np.repeat(values["slots"], 3, 0)
    keys = np.sort(morton(rng.integers(0, 40, (N, 3))))
    return found, models, values, CodingOrder.of(keys, (9, 6))


@pytest.mark.parametrize("slow", [False, True])
def test_values_come_back_and_both_forms_write_the_same(slow):
    found, models, values, order = parts()
    streams = {name: writer.pack() for name, writer in Walk(found, order, models).write(values).items()}
    again = Walk(found, order, models, slow).read(streams)
    assert all(np.array_equal(again[name], values[name]) for name in values)
    assert streams == {name: writer.pack() for name, writer in Walk(found, order, models, slow).write(values).items()}


def test_streams_of_other_models_are_refused():
    found, models, values, order = parts()
    streams = {name: writer.pack() for name, writer in Walk(found, order, models).write(values).items()}
    models["feature"].numbers[:, 0] += 70
    with pytest.raises(Damaged):
        Walk(found, order, models).read(streams)


@pytest.mark.parametrize(
    ("numbers", "scaling"), [((1 << 29, 0, 0, 0), (1, 0)), ((0, 25, 0, 0), (1, 0)), ((0, 0, 0, 0), (0, 0)), ((0, 0, 0, 0), (1, 1 << 29))]
)
def test_models_whose_sums_would_not_fit(numbers, scaling):
    with pytest.raises(Damaged):
        GroupModel([np.zeros((2, 3), np.int8)], np.array([numbers], np.int32), np.array([scaling], np.int32)).checked()


def test_inputs_grow_along_a_chain():
    found = {g.name: g for g in anchor_groups(F, K)}
    channels = {g.name: g.channels for g in found.values()}
    assert inputs_of(found["feature"], channels) == [3 + 7 + F + c for c in range(F)]
    assert inputs_of(found["offsets"], channels) == [3 + 7 + F + 6] * 3 * K
    assert inputs_of(found["class"], channels) == [3 + 1] and groups.SLOTS not in found
    with pytest.raises(Damaged):
        inputs_of(anchor_groups(2100, K)[1], channels)
