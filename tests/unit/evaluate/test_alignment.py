"""Cameras that are aligned with a scene by their photographs."""

import json
from dataclasses import replace

import pytest
import torch

from scene_experts.core.errors import InputError
from scene_experts.core.types import Mode
from scene_experts.evaluate.alignment import ALIGNED, align
from scene_experts.evaluate.options import EvalOptions
from scene_experts.evaluate.score import evaluate
from scene_experts.geometry.poses import exp_motion
from scene_experts.render import choose
from scene_experts.scene.poses import Poses
from scene_experts.training.recipes import RECIPES
from support.captures import load
from support.scenes import CAMERA, start_scene
from support.synthetic import make_capture

MOVED = exp_motion(torch.tensor([0.01, -0.008, 0.012, 0.02, -0.03, 0.01], dtype=torch.float64))


def scene():
    made = start_scene("3dgs")
    made.table.params["sh_dc"].data.normal_(generator=torch.Generator().manual_seed(0))
    return made


def photograph(made, camera, draw):
    with torch.no_grad():
        return draw(made(camera, 1, Mode.DRAW, draw.visible).gaussians, camera, torch.zeros(3)).image.clamp(0, 1)


def off(a, b):
    return float((a.world_to_cam - b.world_to_cam).norm())


def test_a_camera_comes_back_to_where_its_photograph_was_taken():
    made, draw = scene(), choose("cpu", "cpu", deterministic=True)
    photo = photograph(made, CAMERA, draw)
    wrong = replace(CAMERA, world_to_cam=(MOVED @ CAMERA.world_to_cam.double()).float())
    before = {name: value.clone() for name, value in made.state_dict().items()}
    found = align(made, draw, wrong, photo, None, 1, torch.zeros(3), made.extent)
    assert off(found, CAMERA) < 0.3 * off(wrong, CAMERA)
    assert all(torch.equal(before[name], value) for name, value in made.state_dict().items())
    assert align(made, draw, CAMERA, photo, None, 1, torch.zeros(3), made.extent) is CAMERA  # nothing is better than no error


def test_pixels_that_do_not_count_do_not_align():
    made, draw = scene(), choose("cpu", "cpu", deterministic=True)
    wrong = replace(CAMERA, world_to_cam=(MOVED @ CAMERA.world_to_cam.double()).float())
    none = torch.zeros(CAMERA.height, CAMERA.width)
    assert align(made, draw, wrong, photograph(made, CAMERA, draw), none, 1, torch.zeros(3), made.extent) is wrong


def test_a_camera_that_sees_nothing_stays():
    made, draw = scene(), choose("cpu", "cpu", deterministic=True)
    away = CAMERA.world_to_cam.clone()
    away[2, 3] = -1000.0
    camera = replace(CAMERA, world_to_cam=away)
    assert align(made, draw, camera, torch.rand(CAMERA.height, CAMERA.width, 3), None, 1, torch.zeros(3), made.extent) is camera


@pytest.mark.parametrize("views", ["test", "train"])
def test_an_evaluation_says_that_it_has_aligned(tmp_path, views):
    capture = load(make_capture(tmp_path / "capture", views=9, size=(24, 16), points=60).folder)
    cameras = [capture.views[i].camera for i in capture.train]
    made = RECIPES["scaffold-gs"][1].scene.start(capture.points, capture.extent, cameras)
    made.poses = Poses(cameras, capture.extent)
    evaluate(made, capture, choose("auto", "cpu"), tmp_path / "out", EvalOptions(lpips=False, views=views), step=1)
    capture.images.close()
    results = json.loads((tmp_path / "out" / ("results.json" if views == "test" else "results_train.json")).read_text())
    assert results.get("alignment") == (ALIGNED if views == "test" else None)


def test_cameras_of_other_runs_are_aligned_on_request(tmp_path):
    capture = load(make_capture(tmp_path / "capture", views=9, size=(24, 16), points=60).folder)
    made = RECIPES["scaffold-gs"][1].scene.start(capture.points, capture.extent, [capture.views[i].camera for i in capture.train])
    options = EvalOptions(lpips=False, align_poses=True)
    found = evaluate(made, capture, choose("auto", "cpu"), tmp_path / "out", options, step=1)
    assert found["alignment"] == ALIGNED
    with pytest.raises(InputError, match="leave --align-poses out"):
        evaluate(made, capture, choose("auto", "cpu"), tmp_path / "out", replace(options, views="train"), step=1)
    capture.images.close()
