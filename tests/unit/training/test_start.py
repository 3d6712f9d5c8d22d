"""Where trainings start: densely where it is asked for, or where the recipe does with few views."""

import re
from dataclasses import replace

import pytest
import torch

from scene_experts.core.errors import InputError
from scene_experts.core.types import Mode
from scene_experts.data.far import add_far_points
from scene_experts.data.settings import Data
from scene_experts.native import library as native
from scene_experts.render import choose
from scene_experts.training.events import Finished, Stepped
from scene_experts.training.losses import Weights, depth_error
from scene_experts.training.start import start
from scene_experts.training.state import resume
from support.captures import load
from support.depths import make_depths
from support.lanes import slow_except
from support.planes import hole, make_planes, plane
from support.synthetic import make_capture
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


def test_depth_maps_count_are_told_and_resume_bit_for_bit(tmp_path):
    cfg, folder = config("scaffold-gs", loss=Weights(scale=0.01, depth=0.2)), make_depths(tmp_path / "planes")
    begun, *rest, _ = events(cfg, folder, tmp_path / "whole", stop_at=12)
    assert begun.start == "the depth maps of 4 of 4 training photographs count in the loss; --loss.depth 0 leaves them out"
    shown = [event.terms for event in rest if isinstance(event, Stepped)]
    assert shown and all(0 < terms["depth"] < 0.2 * 0.2 for terms in shown)
    list(events(cfg, folder, tmp_path / "parts", stop_at=5))
    list(events(cfg, folder, tmp_path / "parts", stop_at=12, resume=True))
    assert_same(last_tensors(tmp_path / "whole"), last_tensors(tmp_path / "parts"))
    off, *rest, _ = events(replace(cfg, loss=Weights(scale=0.01)), folder, stop_at=10)
    assert off.start == "" and all("depth" not in event.terms for event in rest if isinstance(event, Stepped))
    none, *rest, _ = events(cfg, make_planes(tmp_path / "none", plane(4.0)), stop_at=10)
    assert none.start == "" and all("depth" not in event.terms for event in rest if isinstance(event, Stepped))


def test_the_loss_of_depth_moves_the_scene_to_the_depth_of_the_maps(tmp_path):
    folder, found = make_depths(tmp_path / "planes"), []
    for weight in (0.0, 2.0):
        cfg = config("scaffold-gs", loss=Weights(scale=0.01, depth=weight))
        run = tmp_path / str(weight)
        list(events(cfg, folder, run, stop_at=150))
        training = resume(cfg.scaled(), run / "checkpoints", "cpu")
        capture = load(folder)
        camera = capture.views[2].camera
        draw = choose("auto", "cpu")
        drawn = draw(training.scene(camera, 150, Mode.DRAW, draw.visible).gaussians, camera, torch.zeros(3))
        found.append(depth_error(drawn.depth, drawn.alpha, capture.depth(2)).item())
    assert found[1] < 0.7 * found[0]


def test_a_rate_that_leaves_little_of_the_scene_is_told(tmp_path, caplog):
    folder = make_planes(tmp_path / "planes", plane(4.0))
    next(events(config("scaffold-gs", rate=0.002), folder, stop_at=1))
    assert "--rate" not in caplog.text
    next(events(config("scaffold-gs", rate=100.0), folder, stop_at=1))
    assert "--rate 100 makes bits count so much" in caplog.text


def test_far_points_are_added_where_the_recipe_asks_and_init_does_not_say_otherwise(tmp_path):
    folder = make_capture(tmp_path / "box", views=9, size=(48, 32), points=40, mixed_sizes=False).folder
    cfg, started = config("scaffold-gs", far_points=5.0), {}
    for name, (recipe, init) in {"with": (cfg, "auto"), "points": (cfg, "points"), "none": (config("scaffold-gs"), "auto")}.items():
        capture = load(folder)
        started[name] = start(recipe.scaled(), Data(folder, init=init), capture, "cpu", torch.float32)
    found = add_far_points(load(folder), 5.0)
    assert found is not None and started["with"].computed == f"{found.describe()}; --init points starts from the capture's own alone"
    assert started["points"].computed == started["none"].computed == "" and started["points"].box == ()
    assert started["with"].box == found.box and started["with"].growth.box == found.box and started["points"].growth.box == ()
    assert started["with"].scene.table.total > started["points"].scene.table.total == started["none"].scene.table.total


def test_nothing_grows_far_away_and_a_resumed_training_knows_it(tmp_path):
    folder = make_capture(tmp_path / "box", views=9, size=(48, 32), points=40, mixed_sizes=False).folder
    cfg = config("scaffold-gs", far_points=5.0)
    list(events(cfg, folder, tmp_path / "whole", stop_at=40, init="auto"))
    list(events(cfg, folder, tmp_path / "parts", stop_at=15, init="auto"))
    list(events(cfg, folder, tmp_path / "parts", stop_at=40, resume=True, init="auto"))
    assert_same(last_tensors(tmp_path / "whole"), last_tensors(tmp_path / "parts"))
    box = add_far_points(load(folder), 5.0).box
    assert resume(cfg.scaled(), tmp_path / "parts" / "checkpoints", "cpu").growth.box == box
    low, high = torch.tensor(box).view(2, 3)
    began = start(cfg.scaled(), Data(folder), load(folder), "cpu", torch.float32).scene.positions
    ended = resume(cfg.scaled(), tmp_path / "whole" / "checkpoints", "cpu").scene.positions
    outside = [int((~((xyz >= low) & (xyz <= high)).all(1)).sum()) for xyz in (began, ended)]
    assert 0 < outside[1] <= outside[0] and len(ended) > len(began)


def test_options_without_an_effect_on_this_capture_are_told(tmp_path, caplog):
    folder = make_capture(tmp_path / "box", views=9, size=(48, 32), points=300).folder
    cfg = config("scaffold-gs")
    list(events(cfg, folder, stop_at=1))
    assert "no effect" not in caplog.text
    list(events(replace(cfg, half_until=10, loss=replace(cfg.loss, depth=0.5), iterations=2), folder, stop_at=3))
    told = [record.getMessage() for record in caplog.records if "no effect here" in record.getMessage()]
    assert len(told) == 1 and all(f"{flag} (" in told[0] for flag in ("--loss.depth", "--half-until", "--stop-at"))
    plain = config("one-network")  # its own numbers are not said to be idle
    caplog.clear()
    list(events(plain, folder, stop_at=1))
    assert "no effect" not in caplog.text
