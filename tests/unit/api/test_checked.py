"""Arguments become plain numbers, or are refused by their name."""

from pathlib import Path

import numpy as np
import pytest

import scene_experts as se
from scene_experts.api import checked
from scene_experts.data.settings import Data


def test_numbers_of_numpy_become_plain_ones():
    values = checked.integer("a", np.int64(3), 1), checked.real("a", np.float32(0.5)), checked.boolean("a", np.bool_(False))
    assert values == (3, 0.5, False) and [type(value) for value in values] == [int, float, bool]


@pytest.mark.parametrize("value", [1.0, "1", None, 0, float("nan"), True])
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


def test_a_tuple_may_be_an_array():
    made = checked.fields(Data, {"path": Path("c"), "background": np.array([0.0, 0.5, 1.0], np.float32)})
    assert made.background == (0.0, 0.5, 1.0) and type(made.background[1]) is float
    with pytest.raises(se.InputError, match="background as 3 numbers"):
        checked.fields(Data, {"path": Path("c"), "background": np.zeros(4)})


def test_options_of_another_type_are_refused_before_anything_happens():
    with pytest.raises(se.InputError, match="max_memory as a finite number, found '3'"):
        se.Trainer("moe-gs", "nowhere", max_memory="3")  # type: ignore[arg-type]
