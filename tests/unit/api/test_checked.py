"""Arguments become plain numbers, or are refused by their name."""

import numpy as np
import pytest

import scene_experts as se
from scene_experts.api import checked


def test_numbers_of_numpy_become_plain_ones():
    values = checked.integer("a", np.int64(3), 1), checked.real("a", np.float32(0.5)), checked.boolean("a", np.bool_(False))
    assert values == (3, 0.5, False) and [type(value) for value in values] == [int, float, bool]


@pytest.mark.parametrize("value", [1.0, "1", None, 0, float("nan")])
def test_what_is_no_integer_is_refused(value):
    with pytest.raises(se.InputError, match="stop_at as an integer of at least 1"):
        checked.integer("stop_at", value, 1)


@pytest.mark.parametrize("value", ["1", None, float("inf"), float("nan"), 1j])
def test_what_is_no_finite_number_is_refused(value):
    with pytest.raises(se.InputError, match="near as a finite number"):
        checked.real("near", value)


@pytest.mark.parametrize("value", [1, 0, "yes", None])
def test_what_is_neither_true_nor_false_is_refused(value):
    with pytest.raises(se.InputError, match="deterministic as True or False"):
        checked.boolean("deterministic", value)
