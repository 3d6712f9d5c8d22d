"""Depth maps and points must have one unit."""

from dataclasses import replace

import pytest
import torch

from scene_experts.core.types import Points
from scene_experts.data.depth_check import check_depths, find_ratio
from scene_experts.data.summary import summarise
from support.captures import load
from support.depths import make_depths


def test_maps_that_agree_with_the_points_are_kept(tmp_path):
    capture = load(make_depths(tmp_path / "planes", cloud=True))
    assert find_ratio(capture, 0) == pytest.approx(1, abs=0.01) and summarise(capture)["depth_maps"] == 5
    assert not any("depth maps" in w for w in capture.warnings)


def test_maps_in_another_unit_are_left_out_and_the_ratio_is_told(tmp_path):
    capture = load(make_depths(tmp_path / "planes", times=0.5, cloud=True))
    told = [w for w in capture.warnings if "depth maps" in w]
    assert len(told) == 1 and told[0].startswith("5 of 5 depth maps are left out: the points lie at 2 times their depth; give maps in")
    assert summarise(capture)["depth_maps"] == 0 and capture.depth(0) is None


@pytest.mark.parametrize("ratios, left, told", [
    ((0.5, None, 1.0, 1.0, 2.0), 3, "2 of 5 depth maps are left out: the points lie at 0.5 to 2 times"),
    ((0.5, 0.8, 1.0, None, 2.0), 0, "5 of 5 depth maps are left out: the points lie at 0.5 to 2 times"),
    ((1.0, 1.05, 0.95, None, 1.0), 5, ""),
])  # fmt: skip
def test_single_maps_are_left_out_or_all_where_most_are_wrong(tmp_path, monkeypatch, ratios, left, told):
    capture = load(make_depths(tmp_path / "planes", cloud=True))
    monkeypatch.setattr("scene_experts.data.depth_check.find_ratio", lambda _, i: ratios[i])
    found = check_depths(capture)
    assert summarise(found)["depth_maps"] == left and (found is capture if left == 5 else found.warnings[-1].startswith(told))


def test_hidden_points_do_not_count_and_few_say_nothing(tmp_path):
    capture = load(make_depths(tmp_path / "planes", cloud=True))
    points = capture.points
    assert points is not None
    behind = points.xyz + 3 * (points.xyz - capture.views[0].camera.position.double())  # on the same rays, four times as far
    both = replace(capture, points=Points(torch.cat((behind, points.xyz)), points.rgb.repeat(2, 1)))
    assert find_ratio(both, 0) == pytest.approx(1, abs=0.01)
    few = replace(capture, points=Points(points.xyz[:10], points.rgb[:10]))
    assert find_ratio(few, 0) is None and check_depths(few) is few


def test_captures_without_maps_or_points_are_not_changed(tmp_path):
    capture = load(make_depths(tmp_path / "planes", cloud=True))
    for other in (replace(capture, points=None), replace(capture, random_points=True)):
        assert check_depths(other) is other
    bare = replace(capture, views=tuple(replace(v, depth=None) for v in capture.views))
    assert check_depths(bare) is bare


def test_maps_that_cannot_be_read_are_left_out_and_told(tmp_path):
    folder = make_depths(tmp_path / "planes", cloud=True)
    (folder / "depth/1.png").write_bytes(b"no picture")
    capture = load(folder)
    assert summarise(capture)["depth_maps"] == 4 and capture.depth(1) is None
    assert [w for w in capture.warnings if w.startswith("1 of 5 depth maps are left out (first: ") and "1.png" in w]
