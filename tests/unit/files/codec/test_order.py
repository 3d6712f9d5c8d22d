"""Levels from cells alone: shares, order and parents."""

import numpy as np
import pytest

from scene_experts.core.reading.budget import Damaged
from scene_experts.files.codec.order import CodingOrder, choose_boxes
from scene_experts.files.formats.morton import morton


def keys(n=500):
    return np.sort(morton(np.random.default_rng(0).integers(0, 60, (n, 3))))


def test_levels_have_at_most_their_shares_and_parents_are_coarser():
    found = keys()
    order = CodingOrder.of(found, choose_boxes(found))
    sizes = [places.stop - places.start for places in order.levels]
    assert sum(sizes) == 500 and 0 < sizes[0] <= 500 / 12 and sizes[0] + sizes[1] <= 500 / 3
    assert sorted(order.rows.tolist()) == list(range(500))
    for level, (parents, weights) in enumerate(order.parents):
        first = order.levels[level].start
        assert (weights.sum(1) <= 256).all() and not weights[parents >= max(first, 1)].any()
        assert (weights.sum(1) > 250).all() == (level > 0)
    for places in order.levels:
        assert (np.diff(order.rows[places]) > 0).all()


def test_the_slow_form_is_the_same():
    found = keys(90)
    fast, slow = (CodingOrder.of(found, (9, 6), slow=slow) for slow in (False, True))
    assert all(np.array_equal(a, b) for x, y in zip(fast.parents, slow.parents) for a, b in zip(x, y))


@pytest.mark.parametrize("n", [0, 1, 2])
def test_few_anchors(n):
    found = keys(n)
    order = CodingOrder.of(found, choose_boxes(found))
    assert len(order.rows) == n and order.ends[-1] == n


def test_boxes_that_are_none():
    with pytest.raises(Damaged):
        CodingOrder.of(keys(3), (64, 0))
