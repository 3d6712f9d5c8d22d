"""The codec's tables against the formulas that they round, and its octree against sets."""

import math

import numpy as np
import pytest

from scene_experts.files.codec import reference
from scene_experts.files.formats.morton import morton, unmorton


def test_constants_are_the_rounded_powers_of_two():
    assert list(reference.SLOPES) == [round(2**27 * math.log2(math.e) * 2 ** (-j / 8)) for j in range(8)]
    assert list(reference.ROOTS) == [round(2**26 * 2 ** -(2.0**-b)) for b in range(1, 17)]


@pytest.mark.parametrize("u", [0.0, 0.3, 1.0, 3.7, 12.5, 25.9, 26.0, 400.0])
def test_powers_and_tails(u):
    fixed = int(u * 2**26)
    assert reference.power(fixed) / 2**26 == pytest.approx(2**-u, abs=2e-5)
    assert reference.tail(fixed) / 2**20 == pytest.approx(1 / (1 + 2**u), abs=2e-5)


@pytest.mark.parametrize(("scale", "phase"), [(0, 0), (0, 4), (20, 7), (32, 4), (47, 0)])
def test_a_table_is_the_logistic_distribution(scale, phase):
    row = np.array(reference.table(scale, phase))
    assert row[0] == 0 and row[-1] == 1 << 15 and (np.diff(row) >= 1).all()
    spread, mean = 2 ** (scale / 8 - 4), (phase - 4) / 8
    edges = (np.arange(-40, 42) - 0.5 - mean) / spread
    wanted = 1 / (1 + np.exp(-edges.clip(-60, 60)))
    assert np.abs(np.diff(row[:-1]) / 2**15 - np.diff(wanted)).max() < 0.004


@pytest.mark.parametrize("odds", [0, 40, 64, 72, 127])
def test_odds(odds):
    ones = 1 - reference.zeros(odds) / 2**15
    assert ones == pytest.approx(1 / (1 + 2 ** -((odds - 64) / 8)), abs=2e-4) and 0 < ones < 1


def test_a_step_along_an_axis():
    cells = np.array([[0, 5, 7], [7, 0, 3]])
    for cell, key in zip(cells, morton(cells).tolist()):
        for axis in range(3):
            for by in (-1, 1):
                moved = cell.copy()
                moved[axis] += by
                found = reference.step(key, axis, by, 3)
                assert found == (int(morton(moved[None])[0]) if 0 <= moved[axis] < 8 else -1)


def test_cells_of_a_surface_take_few_bits():
    rng = np.random.default_rng(0)
    direction = rng.normal(size=(1500, 3))
    cells = np.unique(np.rint(20 + 18 * direction / np.linalg.norm(direction, axis=1, keepdims=True)).astype(np.int64), axis=0)
    keys = np.sort(morton(cells)).astype(np.int64)
    operations = reference.code_cells(keys, 6)
    bits = float((15 - np.log2(operations & 0xFFFF)).sum()) / len(keys)
    assert bits < 6 and len(unmorton(keys.astype(np.uint64))) == len(cells)  # 13 would tell them among all cells of the cube
    assert np.array_equal(reference.read_cells(reference.WordReader(reference.pack(operations)), 6, len(keys)), keys)


def test_inputs_saturate_and_round():
    values, classes = np.array([0, 3, -3, 1 << 30], np.int32), np.array([0, 0, -2, 4], np.int8)
    assert reference.as_inputs(values, classes, 1024, 0).tolist() == [0, 3, -1, 2047]
