"""Views are compared with those that see the same things from about ten degrees aside."""

import numpy as np
import pytest
import torch

from scene_experts.data.dense import pairs as pairs_module
from scene_experts.data.dense.pairs import Pairs, choose_pairs
from support.planes import plane, pose, reduced

POINTS = np.stack(np.meshgrid(np.linspace(-0.5, 0.5, 12), np.linspace(-0.4, 0.4, 12), [4.0]), -1).reshape(-1, 3)


def views(*cameras):
    return reduced(plane(4.0), list(cameras), size=(24, 18), focal=24.0)[0]


def at_angle(degrees):
    """A camera aside from the axis, whose ray to (0, 0, 4) makes this angle with the axis."""
    angle = np.radians(degrees)
    return pose(4 * np.tan(angle), -angle)


def test_the_best_angle_is_ten_degrees_and_larger_ones_are_better_than_smaller():
    pictures = views(at_angle(0), at_angle(1), at_angle(4), at_angle(10), at_angle(14), at_angle(25))
    pairs = choose_pairs(pictures, POINTS, 4)
    assert pairs.compared[0].tolist() == [3, 4, 2, 5] and pairs.compared.dtype == torch.int32


def test_views_that_share_nothing_are_not_compared():
    away = pose(0.0, np.pi)
    pairs = choose_pairs(views(at_angle(0), at_angle(8), away, at_angle(12)), POINTS, 3)
    assert pairs.compared[0].tolist() == [3, 1, -1] and pairs.compared[2].tolist() == [-1] * 3
    assert pairs.planes[2].tolist() == [0, 0] and pairs.swept == 3


def test_a_view_with_one_companion_has_no_sweep():
    pairs = choose_pairs(views(at_angle(0), at_angle(8), pose(0.0, np.pi)), POINTS, 3)
    assert pairs.swept == 0 and not pairs.planes.any()


def test_the_range_reaches_beyond_the_depths_of_the_points():
    xyz = np.concatenate((POINTS * (0.5, 0.5, 0.5), POINTS, POINTS * (1, 1, 2)))
    near, far = 1 / choose_pairs(views(at_angle(0), at_angle(8), at_angle(12)), xyz, 2).planes[0].flip(0)
    assert (float(near), float(far)) == (pytest.approx(0.8 * 2), pytest.approx(1.3 * 8))


def test_partners_are_known_to_each_other():
    compared = torch.tensor([[1, 2], [0, -1], [3, 0], [2, 0]], dtype=torch.int32)
    first, others = Pairs(compared, torch.ones(4, 2, dtype=torch.float64)).partners()
    assert first.tolist() == [0, 3, 4, 6, 8] and others.tolist() == [1, 2, 3, 0, 0, 3, 0, 2]


def test_many_points_and_few_points_choose_alike():
    pictures = views(at_angle(0), at_angle(2), at_angle(9), at_angle(15))
    many = np.repeat(POINTS, 40, 0)
    assert torch.equal(choose_pairs(pictures, POINTS, 2).compared, choose_pairs(pictures, many, 2).compared)


def test_of_many_views_the_likely_ones_are_measured_and_the_choice_is_the_same(monkeypatch):
    pictures = views(*(at_angle(degrees) for degrees in np.linspace(-30, 30, 45)))
    chosen = choose_pairs(pictures, POINTS, 5).compared
    monkeypatch.setattr(pairs_module, "_MEASURED_VIEWS", 1000)
    assert torch.equal(choose_pairs(pictures, POINTS, 5).compared, chosen)
