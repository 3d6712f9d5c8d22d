"""Where trainings start: densely where it is asked for, or where the recipe does with few views."""

import re
from dataclasses import replace

import pytest

from scene_experts.core.errors import InputError
from scene_experts.native import library as native
from scene_experts.training.events import Finished
from support.lanes import slow_except
from support.planes import hole, make_planes, plane
from support.trainings import assert_same, config, events, last_tensors


@pytest.mark.skipif(native.load() is None, reason="no compiled library")
@pytest.mark.parametrize("recipe", slow_except(("scene-experts", "3dgs", "sags"), "scene-experts"))
def test_a_dense_start_is_told_and_resumed_bit_for_bit(recipe, tmp_path):
    cfg, folder = config(recipe), make_planes(tmp_path / "planes", plane(4.0))
    plain = next(events(cfg, folder, stop_at=1))
    begun, *_, last = events(cfg, folder, tmp_path / "whole", stop_at=8, init="dense")
    assert "points by a plane sweep over 7 views" in begun.start and plain.start == "" and begun.anchors != plain.anchors
    list(events(cfg, folder, tmp_path / "parts", stop_at=4, init="dense"))
    resumed, *_ = events(cfg, folder, tmp_path / "parts", stop_at=8, init="dense", resume=True)
    assert (resumed.step, resumed.start, type(last)) == (4, "", Finished)
    assert_same(last_tensors(tmp_path / "whole"), last_tensors(tmp_path / "parts"))


@pytest.mark.skipif(native.load() is None, reason="no compiled library")
def test_a_recipe_starts_densely_with_few_views_and_few_points_and_says_so(tmp_path, monkeypatch):
    cfg, folder = config("scaffold-gs", dense_views=7), make_planes(tmp_path / "planes", plane(4.0))
    asked, few = (next(events(c, folder, stop_at=1, init=init)) for c, init in ((cfg, "dense"), (cfg, "auto")))
    told = [re.sub(r"\(.* s CPU\)", "", begun.start) for begun in (asked, few)]
    assert few.anchors == asked.anchors and told[1] == f"{told[0]}; --init points starts from the capture's own"
    plain = next(events(cfg, folder, stop_at=1, init="points"))
    many = next(events(replace(cfg, dense_views=6), folder, stop_at=1, init="auto"))
    assert plain.start == many.start == "" and plain.anchors == many.anchors
    monkeypatch.setattr("scene_experts.training.start.ENOUGH", 1)
    own = next(events(cfg, folder, stop_at=1, init="auto"))
    assert own.start == "" and own.anchors == plain.anchors
    monkeypatch.undo()
    flat = make_planes(tmp_path / "grey", hole(3.0, 50.0, 4.0))
    without = next(events(cfg, flat, stop_at=1, init="auto"))
    assert "finds no denser ones: it needs photographs that show depth and found it in 0.0 % of their pixels" in without.start
    with pytest.raises(InputError, match="--init dense"):
        next(events(cfg, flat, stop_at=1, init="dense"))
