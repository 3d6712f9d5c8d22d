"""What a file costs: the same pictures score the same, others what they are."""

from dataclasses import replace

import pytest
import torch
from PIL import Image

from scene_experts.core.errors import InputError
from scene_experts.evaluate.metrics import psnr
from scene_experts.files.gaussians.read import scene_of
from scene_experts.files.measure import Painter, Score, capture_if_there, cost, scored_views, scores, why_no_views
from scene_experts.render import choose
from scene_experts.training.recipes import RECIPES
from support.captures import load
from support.files import run_in_memory
from support.synthetic import make_capture


def test_scores_are_means_over_views_of_8_bit_pictures(tmp_path):
    capture = load(make_capture(tmp_path, views=9, size=(48, 32), points=200).folder)
    scene = RECIPES["3dgs"][1].scene.start(capture.points, capture.extent)
    columns = {name: value.detach() for name, value in scene.table.params.items()}
    darker = scene_of(columns | {"sh_dc": columns["sh_dc"] - 0.3}, capture.extent)
    draw, said = choose("auto", "cpu"), []
    painters = {"a": Painter.of(scene, 0, draw), "b": Painter.of(darker, 3, draw)}
    found = scores(painters, capture, capture.test, lambda *what: said.append(what))
    assert found["a"].first == 100 and found["b"].first < 60 and said[-1] == ("measuring", 2, 2)
    by_hand = []
    for index in capture.test:
        with torch.no_grad():
            image = painters["b"].picture_8bit(capture.views[index].camera, torch.tensor(capture.background))
        assert torch.equal((image * 255).round() / 255, image)
        by_hand.append(psnr(image, capture.frame(index).rgb.float() / 255))
    assert found["b"].photographs == pytest.approx(sum(by_hand) / len(by_hand), abs=1e-6)
    capture.images.close()


def test_views_whose_mask_counts_nothing_are_not_scored(tmp_path):
    folder = make_capture(tmp_path, views=17, size=(24, 16), points=60).folder
    capture = load(folder)
    first, second = (capture.views[i] for i in capture.test[:2])
    capture.images.close()
    assert why_no_views(replace(capture, test=())) != why_no_views(capture)
    for view, value in ((first, 0), (second, 255)):
        name = folder / "masks" / f"{view.name}.png"
        name.parent.mkdir(parents=True, exist_ok=True)
        Image.new("L", (view.camera.width, view.camera.height), value).save(name)
    capture = load(folder)
    assert capture.frame(capture.test[0]).mask is not None and scored_views(capture) == list(capture.test[1:])
    scene = RECIPES["3dgs"][1].scene.start(capture.points, capture.extent)
    painter = Painter.of(scene, 0, choose("auto", "cpu"))
    assert scores({"a": painter}, capture, scored_views(capture))["a"].first == 100
    capture.images.close()


def test_the_cost_of_a_file_in_figures_and_in_a_sentence(tmp_path):
    capture = load(make_capture(tmp_path, views=9, size=(24, 16), points=60).folder)
    scene, draw = RECIPES["3dgs"][1].scene.start(capture.points, capture.extent), choose("auto", "cpu")
    run = replace(run_in_memory("3dgs", 0), scene=scene)
    found = cost(run, lambda: {"file": (scene, 0)}, capture, draw)
    assert found.psnr["run"] == found.psnr["file"] and "+0.000" in found.lines[0]
    assert found.plain["file"]["run"] == 100 and found.plain["views"] == 2
    for nothing in (cost(run, dict, None), cost(run, dict, replace(capture, test=()))):
        assert nothing.psnr == {} == nothing.plain and len(nothing.lines) == 1
    assert "--data" in cost(run, dict, None).lines[0]
    capture.images.close()


def test_a_loss_is_a_warning_that_says_where_it_is(tmp_path, monkeypatch):
    capture = load(make_capture(tmp_path, views=9, size=(24, 16), points=60).folder)
    run = replace(run_in_memory("3dgs", 0), scene=RECIPES["3dgs"][1].scene.start(capture.points, capture.extent))
    for levels, said in (
        ({"run": 30, "file": 28}, "--format"),
        ({"run": 30, "bake": 29.8, "file": 28}, "--format"),
        ({"run": 30, "bake": 28.3, "file": 28}, "refine"),
        ({"run": 30, "bake": 29, "file": 29.5}, None),
    ):
        monkeypatch.setattr("scene_experts.files.measure.scores", lambda *a, n=levels: {k: Score(v, 40) for k, v in n.items()})
        told = [line for line in cost(run, dict, capture).lines if line.startswith("warning")]
        assert len(told) == (said is not None) and all("2.0 dB" in line and said in line for line in told)
    capture.images.close()


def test_a_capture_that_is_gone_is_an_error_only_where_it_is_needed(tmp_path):
    run = run_in_memory("3dgs")
    with capture_if_there(run, needed=False) as capture:
        assert capture is None
    with pytest.raises(InputError, match="--data"), capture_if_there(run, needed=True):
        pass
