"""Lattices of several levels against the formulas of Octree-GS, point by point."""

from dataclasses import replace

import pytest
import torch

from scene_experts.scene.anchors.levels import Levels, blend_levels, cube, distances, level_count, occupied, whole, within_reach
from support.octree import camera_at, slow_level

LEVELS = Levels(4, 2, 2, 0.8, (-1.0, -1.0, -1.0), 8.0, "round", 0.5, ((0.0, 0.0, -1.0), (0.0, 0.0, -9.0), (3.0, 0.0, 0.5)))


def test_the_level_that_a_distance_asks_for():
    torch.manual_seed(0)
    xyz, level = torch.rand(30, 3), torch.randint(0, 4, (30,))
    for position in LEVELS.cameras:
        asked = LEVELS.asked(xyz, level, torch.tensor(position))
        for i in range(30):
            assert float(asked[i]) == pytest.approx(slow_level(xyz[i].tolist(), int(level[i]), position), abs=1e-4)


def test_whole_levels():
    asked = torch.tensor([-3.0, 0.4, 0.6, 1.2, 1.7, 9.0])
    assert whole(asked, "round", 4).tolist() == [0, 0, 1, 1, 2, 3]
    assert whole(asked, "floor", 4).tolist() == [0, 0, 0, 1, 1, 3]
    assert whole(asked, "ceil", 4).tolist() == [0, 1, 1, 2, 2, 3]
    assert whole(asked, "blend", 4).tolist() == [0, 1, 1, 2, 2, 3]
    torch.testing.assert_close(blend_levels(asked, 4), torch.tensor([0.9999, 1.4, 1.6, 2.2, 2.7, 3.9999]))


def test_shares_and_weeding_by_counting():
    torch.manual_seed(1)
    xyz, level = torch.rand(40, 3), torch.randint(0, 4, (40,))
    share = LEVELS.share(xyz, level)
    for i in range(40):
        votes = [int(level[i]) <= min(max(round(slow_level(xyz[i].tolist(), int(level[i]), c)), 0), 3) for c in LEVELS.cameras]
        assert float(share[i]) == pytest.approx(sum(votes) / 3)
    assert LEVELS.wanted(xyz, level).tolist() == [s > 0.5 or s == 1 for s in share.tolist()]
    assert replace(LEVELS, threshold=1.0).wanted(xyz, level).tolist() == (share == 1).tolist()  # one share for all: nobody is weeded


def test_how_many_levels():
    points = torch.tensor([[0.0, 0, 1], [0, 0, 2], [0, 0, 2], [0, 0, 4]], dtype=torch.float64)  # one twice
    far, near = distances(points, [camera_at(0, 0, 0), camera_at(0, 0, -4)], 1.0)
    assert (far, near) == (8.0, 1.0) and level_count(far, near, 2) == 4
    assert level_count(8.0, 1.0, 8) == 2 and level_count(1.0, 1.0, 2) == 1 and level_count(1.0, 0.0, 2) == 1
    inner, outer = distances(points, [camera_at(0, 0, 0)], 0.75)  # distances 1, 2, 4: quantiles 3 and 1.5, and again of those two
    assert (inner, outer) == pytest.approx((1.5 + 0.75 * 1.5, 1.5 + 0.25 * 1.5))


def test_the_cube_grows_about_its_centre():
    points = torch.tensor([[10.0, 11, 12], [20, 13, 14]])
    low, edge = cube(points, 1.1)
    assert edge == pytest.approx(11) and low == pytest.approx(9.5)


def test_cells_and_positions_of_every_level():
    torch.manual_seed(2)
    points = torch.rand(50, 3, dtype=torch.float64) * 2 - 1
    cells, level = occupied(LEVELS, points)
    for j in range(4):
        size, mine = 0.8 / 2**j, cells[level == j]
        assert LEVELS.size(j) == pytest.approx(size)
        expected = {tuple(round((c + 1) / size) for c in p) for p in points.tolist()}
        assert {tuple(c) for c in mine.tolist()} == expected and len(mine) == len(expected)
        assert (LEVELS.positions(LEVELS.cells(points, j), j) - points).abs().max() <= size / 2 + 1e-12


def test_no_more_levels_than_cells_can_be_told_apart(caplog):
    assert within_reach(5, 0.1, 10.0, 2) == 5
    assert within_reach(30, 0.1, 10.0, 2) == 14  # 100 * 2^13 < 2^20 <= 100 * 2^14
    assert caplog.records


def test_plain_values_and_back():
    assert Levels.from_meta(LEVELS.meta()) == LEVELS
