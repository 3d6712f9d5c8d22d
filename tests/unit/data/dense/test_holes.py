"""Parts of a picture without depth get that of their surroundings, or a far one."""

import numpy as np
import pytest

from scene_experts.data.dense.holes import add_points, box_mean, fill_holes, take_nearest


def test_a_small_hole_is_as_far_as_its_rim_and_a_large_one_is_far():
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
    assert len(holes.pixels) == holes.cells and (holes.inverse == 0.1).all()


def test_means_over_squares_are_cut_at_the_border():
    values = np.random.default_rng(0).random((9, 12))
    found = box_mean(values, 5)
    for row in range(9):
        for column in range(12):
            square = values[max(0, row - 2) : row + 3, max(0, column - 2) : column + 3]
            assert found[row, column] == pytest.approx(square.mean())


def test_an_unknown_depth_is_that_of_the_nearest_pixel():
    rng = np.random.default_rng(0)
    inverse = np.where(rng.random((11, 14)) < 0.1, rng.uniform(1, 2, (11, 14)), 0)
    found, known = take_nearest(inverse), np.argwhere(inverse > 0)
    for row, column in np.ndindex(11, 14):
        away = ((known - (row, column)) ** 2).sum(1)
        assert found[row, column] in inverse[tuple(known[away == away.min()].T)]
    assert not take_nearest(np.zeros((5, 7))).any()


def test_points_fill_their_neighbourhood_and_the_nearest_wins():
    inverse = np.zeros((6, 8))
    inverse[2, 3] = 0.5
    found = add_points(inverse, np.array([2 * 8 + 2, 3 * 8 + 3, 0]), np.array([0.1, 0.2, 0.3]))
    assert found[2, 3] == 0.5 and found[1, 1] == 0.3 and found[3, 3] == 0.2 and found[2, 2] == 0.2 and found[3, 1] == 0.1
    assert (found > 0).sum() == 17 and found[0, 0] == 0.3
