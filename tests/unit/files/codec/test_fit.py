"""Fitted models predict what can be predicted, the same on every run."""

import numpy as np
import pytest
import torch

from scene_experts.files.codec.fit import fit_models, one_thread, split
from scene_experts.files.codec.groups import Walk, anchor_groups
from scene_experts.files.codec.order import CodingOrder, choose_boxes
from scene_experts.files.formats.morton import morton

F, K, N = 3, 1, 1500


def values():
    """The second feature follows the first one; masks follow it too."""
    rng = np.random.default_rng(0)
    feature = rng.logistic(size=(F, N)) * 20
    feature[1] = feature[0] + rng.logistic(size=N)
    live = (feature[2] > 0).astype(np.int32)[None]
    found = {"class": np.zeros((1, N)), "feature": feature, "scaling": rng.logistic(size=(6, N)) * 9 - 300, "slots": live}
    found["offsets"] = rng.logistic(size=(3, N)) * 5 * live
    return {name: np.rint(value).astype(np.int32) for name, value in found.items()}


def code(found, models, order, groups):
    return {name: writer.ideal_bits / N for name, writer in Walk(groups, order, models).write(found).items()}


@pytest.mark.slow
def test_the_code_is_nearly_as_short_as_the_distribution_allows():
    keys = np.sort(morton(np.random.default_rng(1).integers(0, 99, (N, 3))))
    groups, order, found = anchor_groups(F, K, True), CodingOrder.of(keys, choose_boxes(keys)), values()
    models = fit_models(groups, order, found)
    bits = code(found, models, order, groups)
    known = lambda scale: np.log2(scale) + 2 / np.log(2)  # entropy of a logistic distribution, steps of 1  # noqa: E731
    assert bits["feature"] < known(20) * 2 + 2.9 + 0.3 and bits["scaling"] < 6 * known(9) + 0.5
    assert bits["slots"] < 0.6 and bits["class"] < 0.1
    again = fit_models(groups, order, found)
    assert all(np.array_equal(a, b) for g in models for a, b in zip(models[g].weights, again[g].weights))


@pytest.mark.parametrize("n", [0, 1, 3])
def test_few_anchors(n):
    keys = np.arange(n, dtype=np.uint64)
    groups, order = anchor_groups(F, K, True), CodingOrder.of(keys, choose_boxes(keys))
    found = {name: value[:, :n] for name, value in values().items()}
    models = fit_models(groups, order, found)
    streams = {name: w.pack() for name, w in Walk(groups, order, models).write(found).items()}
    again = Walk(groups, order, models).read(streams)
    assert all(np.array_equal(again[name], found[name]) for name in found)


@pytest.mark.parametrize(("value", "parts"), [(0, (0, 0)), (-255, (-255, 0)), (256, (128, 1)), (511, (128, 2)), (-1000, (-250, 2))])
def test_coarse_numbers(value, parts):
    assert split(value) == parts and split(parts[0] * 2 ** parts[1]) == parts


def test_one_thread_is_given_back():
    before = torch.get_num_threads()
    with one_thread():
        assert torch.get_num_threads() == 1
    assert torch.get_num_threads() == before
