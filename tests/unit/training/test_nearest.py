"""The near plane of a training: by hand, in the command, the API and a run that is resumed."""

from dataclasses import replace

import numpy as np
import pytest
import torch

import scene_experts as se
from scene_experts.cli import main
from scene_experts.core.types import Points
from scene_experts.data.settings import Data
from scene_experts.training import run_folder
from scene_experts.training.config import RunConfig
from scene_experts.training.nearest import find_nearest, with_near_plane
from scene_experts.training.recipes import RECIPES
from support.captures import load
from support.synthetic import make_capture

SMALL = ("--iterations", "20", "--device", "cpu", "--preview-every", "0")


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return make_capture(tmp_path_factory.mktemp("capture"), views=9, size=(48, 32), points=300, mixed_sizes=False).folder


def setting(folder, share=0.5, **data) -> RunConfig:
    return RunConfig(replace(RECIPES["scaffold-gs"][1], near_share=share), Data(folder, **data))


def by_hand(capture):
    least = []
    for i in capture.train:
        camera, depths = capture.views[i].camera, []
        for point in capture.points.xyz.numpy():
            x, y, z = camera.world_to_cam.double().numpy()[:3] @ [*point, 1]
            u, v = camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy
            if z > 0 and 0 <= u <= camera.width and 0 <= v <= camera.height:
                depths.append(z)
        least.append(sorted(depths)[len(depths) // 100])
    return min(least)


def test_it_is_a_share_of_the_least_depth_that_training_views_show(folder):
    capture = load(folder)
    expected = by_hand(capture)
    assert find_nearest(capture) == pytest.approx(expected, rel=1e-6)
    config, found = with_near_plane(setting(folder), capture)
    assert config.data.near == pytest.approx(expected / 2, rel=6e-3)
    assert {view.camera.near for view in found.views} == {config.data.near}
    assert {view.camera.near for view in load(folder, near=config.data.near).views} == {config.data.near}


def test_what_is_named_or_too_near_or_unknown_keeps_its_near_plane(folder):
    capture = load(folder)
    for config in (setting(folder, share=0.0), setting(folder, share=1e-3)):
        assert with_near_plane(config, capture) == (config, capture)
    config, named = with_near_plane(setting(folder, near=0.3), capture)
    assert config == setting(folder, near=0.3) and {view.camera.near for view in named.views} == {0.3}
    few = Points(capture.points.xyz[:5], capture.points.rgb[:5])
    for other in (replace(capture, random_points=True), replace(capture, points=None), replace(capture, points=few)):
        assert find_nearest(other) is None


def test_a_wrong_point_before_a_camera_does_not_count(folder):
    capture = load(folder)
    camera = capture.views[capture.train[0]].camera
    wrong = camera.position.double() + camera.world_to_cam[2, :3].double() * 0.01
    points = Points(torch.cat([capture.points.xyz, wrong[None]]), torch.cat([capture.points.rgb, capture.points.rgb[:1]]))
    assert find_nearest(replace(capture, points=points)) > 0.5 * find_nearest(capture)


def test_the_command_says_it_keeps_it_and_resumes_with_it(folder, tmp_path, capsys):
    words = ["train", "one-network", "--data", str(folder), "--out", str(tmp_path / "run"), *SMALL]
    assert main([*words, "--stop-at", "10"]) == 0
    near = run_folder.read_config(tmp_path / "run").data.near
    assert near is not None and f"near plane: {near:g}" in capsys.readouterr().out
    assert main([*words, "--resume"]) == 0
    assert run_folder.read_config(tmp_path / "run").data.near == near
    opened = se.open_run(tmp_path / "run")
    assert {view.camera.near for view in opened.capture.loaded.views} == {near}


def test_the_api_does_the_same(folder):
    trainer = se.Trainer(se.recipe("one-network", iterations=20), folder)
    nears = {view.camera.near for view in trainer.capture.loaded.views}
    assert nears == {trainer.capture.data.near} and np.isfinite(trainer.capture.data.near)
    assert nears != {view.camera.near for view in se.load_capture(folder).loaded.views}


def test_the_api_resumes_with_the_near_plane_that_the_run_began_with(folder, tmp_path):
    method = se.recipe("one-network", iterations=20)
    begun = se.Trainer(method, folder, tmp_path / "run", device="cpu", stop_at=10)
    begun.finish()
    resumed = se.Trainer(method, folder, tmp_path / "run", device="cpu", resume=True)
    near = begun.capture.data.near
    assert resumed.capture.data.near == near and {view.camera.near for view in resumed.capture.loaded.views} == {near}
