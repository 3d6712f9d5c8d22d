"""Parts of a picture without depth get that of their surroundings, or a far one."""

import numpy as np
import pytest

from scene_experts.data.dense.holes import box_mean, fill_holes, halve, interpolate


def test_a_small_hole_is_interpolated_and_a_large_one_is_far():
    inverse = np.full((80, 100), 0.25)
    inverse[10:18, 10:18] = 0  # small
    inverse[:, 50:] = 0  # large
    holes = fill_holes(inverse, 0.05)
    rows, columns = holes.pixels // 100, holes.pixels % 100
    assert holes.edge == 4 and holes.cells == 500
    small, deep = columns < 30, columns > 62
    assert small.sum() >= 1 and np.allclose(holes.inverse[small], 0.25) and (holes.inverse[deep] == 0.05).all() and deep.sum() > 150
    assert not (inverse[rows, columns] > 0).any()


def test_a_picture_with_depth_everywhere_has_no_holes():
    holes = fill_holes(np.full((30, 40), 0.5), 0.1)
    assert len(holes.pixels) == 0 and holes.cells > 0


def test_a_picture_without_depth_is_far():
    holes = fill_holes(np.zeros((30, 40)), 0.1)
    assert len(holes.pixels) == holes.cells and (holes.inverse == 0).all() or (holes.inverse == 0.1).all()


def test_means_over_squares_are_cut_at_the_border():
    values = np.random.default_rng(0).random((9, 12))
    found = box_mean(values, 5)
    for row in range(9):
        for column in range(12):
            square = values[max(0, row - 2) : row + 3, max(0, column - 2) : column + 3]
            assert found[row, column] == pytest.approx(square.mean())


def test_interpolation_keeps_what_is_known_and_stays_within_it():
    rng = np.random.default_rng(0)
    values, weight = rng.uniform(1, 2, (21, 34)), (rng.random((21, 34)) < 0.1).astype(float)
    found = interpolate(values * weight, weight)
    assert (found[weight > 0] == values[weight > 0]).all()
    assert found.min() >= values[weight > 0].min() - 1e-12 and found.max() <= values[weight > 0].max() + 1e-12
    assert (interpolate(np.zeros((5, 7)), np.zeros((5, 7))) == 0).all()


def test_halves_are_sums_of_four():
    assert halve(np.arange(6.0).reshape(2, 3)).tolist() == [[0 + 1 + 3 + 4, 2 + 5]]
