"""Refinement: chunks come back, in both forms of the arithmetic, and streams that do not fit are refused."""

import numpy as np
import pytest

from scene_experts.core.reading.budget import Damaged
from scene_experts.files.codec.refine import MORE, CoarsePart, Refiner, fit_refinement, groups_of, refined_groups
from scene_experts.files.formats.morton import morton

F, K, N = 5, 2, 90


def parts(has_slots):
    rng = np.random.default_rng(2)
    groups, is_coarse = groups_of(F, K, has_slots, 1), rng.random(N) < 0.4
    values = {g.name: rng.integers(-60, 60, (g.channels, N)).astype(np.int32) for g in groups}
    values["class"] = values["class"] % 7 - 2
    live = rng.random((K, N)) < (0.7 if has_slots else 2)
    values["slots"] = live.astype(np.int32)
    values["offsets"] *= np.repeat(live, 3, 0)
    coarse = {name: value * is_coarse for name, value in values.items()}
    coarse["slots"] = coarse["slots"] & rng.integers(0, 2, (K, N)).astype(np.int32)
    for name in ("feature", "scaling", "offsets"):
        coarse[name] = (coarse[name] + 8 >> 4) << 4
    coarse["offsets"] = coarse["offsets"] * np.repeat(coarse["slots"], 3, 0)
    part = CoarsePart.of(np.sort(morton(rng.integers(0, 40, (N, 3)))), is_coarse, (2, 0, 1))
    return groups, part, coarse, values, fit_refinement(groups, part, coarse, values)


@pytest.mark.parametrize("has_slots", [False, True])
@pytest.mark.parametrize("slow", [False, True])
def test_chunks_come_back_and_both_forms_write_the_same(has_slots, slow):
    groups, part, coarse, values, models = parts(has_slots)
    writer = Refiner(groups, part, coarse, models)
    streams = [writer.write(i, values) for i in range(3)]
    reader = Refiner(groups, part, coarse, models, slow)
    for i, stream in enumerate(streams):
        done = np.concatenate(part.chunks[: i + 1])
        reader.read(i, stream)
        assert all(np.array_equal(reader.values[name][:, done], value[:, done]) for name, value in values.items())
        assert reader.is_known.sum() == len(set(done) | set(np.flatnonzero(part.is_coarse)))
    again = Refiner(groups, part, coarse, models, slow)
    assert streams == [again.write(i, values) for i in range(3)]


def test_what_does_not_fit_is_refused():
    groups, part, coarse, values, models = parts(True)
    writer, reader = Refiner(groups, part, coarse, models), Refiner(groups, part, coarse, models)
    first, second = (writer.write(i, values) for i in (0, 1))
    for broken in (second, first[:-2], first + b"ab", b""):
        with pytest.raises(Damaged):
            Refiner(groups, part, coarse, models).read(0, broken)
    reader.read(0, first)
    for order in ((0, 0, 1), (1, 2, 3)):
        with pytest.raises(Damaged, match="chunks"):
            CoarsePart.of(np.sort(morton(np.arange(30).reshape(10, 3))), np.ones(10, bool), order)


def test_refined_groups_know_the_coarse_values_of_their_channels():
    groups = groups_of(F, K, False, 0)
    names = {g.name: g for g in refined_groups(groups)}
    assert set(names) == {f"{name}{MORE}" for name in ("feature", "scaling", "offsets")}
    assert names["offsets+"].masked == 3 and names["feature+"].is_chain and names["offsets+"].has_mean


def test_refining_costs_less_than_coding_anew():
    rng = np.random.default_rng(3)
    groups, keys = groups_of(F, K, False, 0), np.sort(morton(rng.integers(0, 99, (2000, 3))))
    values = {g.name: np.rint(rng.normal(0, 40, (g.channels, 2000))).astype(np.int32) for g in groups}
    values["class"] *= 0
    values["slots"] = np.ones((K, 2000), np.int32)
    coarse = {name: (value + 8 >> 4) << 4 if name not in ("class", "slots") else value for name, value in values.items()}
    sizes = []
    for known in (np.ones(2000, bool), np.zeros(2000, bool)):
        part, base = CoarsePart.of(keys, known, (0,)), {name: value * known for name, value in coarse.items()}
        sizes.append(len(Refiner(groups, part, base, fit_refinement(groups, part, base, values)).write(0, values)))
    assert sizes[0] < 0.75 * sizes[1]
