"""Numbers: finite and in range."""

import numpy as np
import pytest
import torch

from scene_experts.core.reading import numbers
from scene_experts.core.reading.budget import Damaged


@pytest.mark.parametrize("bad", [float("nan"), float("inf"), 1e300, -1e300])
def test_arrays_and_tensors_out_of_range(bad):
    for make in (np.array, torch.tensor):
        numbers.expect_range(make([1.0, -2.0]), "values")
        with pytest.raises(Damaged, match="values"):
            numbers.expect_range(make([1.0, bad]), "values")
    numbers.expect_range(np.zeros((0, 3)), "values")
    numbers.expect_range(torch.zeros(0, 3), "values")


def test_single_numbers():
    assert numbers.number(2, "x") == 2.0 and numbers.whole_number(2, "x") == 2
    for bad in (True, None, "2", float("nan"), float("inf"), 10**400, -(10**400), [1]):
        with pytest.raises(Damaged, match="x"):
            numbers.number(bad, "x")
        with pytest.raises(Damaged, match="x"):
            numbers.whole_number(bad, "x")
    with pytest.raises(Damaged):
        numbers.whole_number(2.0, "x")


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16, torch.float32, torch.float64, torch.float8_e5m2, torch.complex64])
def test_finite_tensors(dtype):
    good = {"a": torch.ones(3, dtype=dtype), "b": torch.tensor([2**40]), "c": torch.zeros(0)}
    numbers.expect_finite_tensors(good)
    for bad in (float("nan"), float("inf")):
        with pytest.raises(Damaged, match="a"):
            numbers.expect_finite_tensors(good | {"a": torch.tensor([1, bad]).to(dtype)})


def test_points_without_a_position_are_dropped(tmp_path, caplog):
    xyz = np.array([[0, 0, 0], [np.nan, 0, 0], [0, 1e16, 0], [1e9, 0, 0]])
    assert numbers.usable_rows(xyz, tmp_path).tolist() == [True, False, False, True]
    assert "2 of 4" in caplog.text
