"""Trainings that refine the poses of their cameras."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from scene_experts.core.errors import InputError
from scene_experts.core.types import Mode
from scene_experts.data.settings import Data
from scene_experts.geometry.poses import exp_motion
from scene_experts.render import choose
from scene_experts.scene.poses import Poses
from scene_experts.training import run_folder
from scene_experts.training.config import RunConfig
from scene_experts.training.init_from import start_from
from scene_experts.training.job import Job
from scene_experts.training.loop import preview
from scene_experts.training.shards import check_shard
from scene_experts.training.state import Training
from support.captures import load
from support.synthetic import make_capture
from support.trainings import assert_same, config, events, last_tensors


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return make_capture(tmp_path_factory.mktemp("capture"), views=10).folder


def test_resumed_equals_uninterrupted_bit_for_bit(folder, tmp_path):
    cfg = config("scaffold-gs", refine_poses=True, iterations=40)
    list(events(cfg, folder, tmp_path / "whole", stop_at=20))
    list(events(cfg, folder, tmp_path / "parts", stop_at=10))
    list(events(cfg, folder, tmp_path / "parts", stop_at=20, resume=True))
    assert_same(last_tensors(tmp_path / "whole"), last_tensors(tmp_path / "parts"))
    assert last_tensors(tmp_path / "whole")["poses.motions"].abs().sum() > 0


def test_a_run_is_opened_with_its_cameras(folder, tmp_path):
    cfg = config("scaffold-gs", refine_poses=True, iterations=40)
    run_folder.prepare(tmp_path, RunConfig(cfg, Data(folder)), resume=False)
    list(events(cfg, folder, tmp_path, stop_at=20))
    opened = run_folder.open_run(tmp_path)
    poses, before, after = opened.scene.poses, load(folder), run_folder.capture_of(opened)
    assert poses is not None
    moved = {i for i, (a, b) in enumerate(zip(before.views, after.views)) if not torch.equal(a.camera.world_to_cam, b.camera.world_to_cam)}
    assert moved == set(before.train)
    assert after.poses() == before.poses() and after.fingerprint() == before.fingerprint()


def test_a_training_goes_on_with_the_poses_of_another(folder, tmp_path):
    cfg = config("scaffold-gs", refine_poses=True, iterations=40)
    run_folder.prepare(tmp_path, RunConfig(cfg, Data(folder)), resume=False)
    list(events(cfg, folder, tmp_path, stop_at=20))
    capture, earlier = load(folder), Poses.restore(last_tensors(tmp_path))
    for refine in (True, False):
        now = replace(cfg, refine_poses=refine)
        made = start_from(now.scaled(), tmp_path, capture, "cpu", RunConfig(now, Data(folder)))
        torch.testing.assert_close(made.scene.poses.without_gauge(), earlier.without_gauge(), rtol=0, atol=1e-6)
        assert any(g["name"] == "poses" for g in made.optimizer.param_groups) == refine
        assert made.scene.poses.motions.requires_grad == refine


def test_shards_refuse_refined_poses():
    with pytest.raises(InputError, match="--refine-poses"):
        check_shard(replace(config("scaffold-gs"), refine_poses=True), 0.0, viewer=False)


@pytest.mark.slow
def test_disturbed_poses_are_found_again(folder):
    """Cameras that were turned by 0.5 degrees come nearer to where they were."""
    capture, generator = load(folder), torch.Generator().manual_seed(0)
    true = {view.camera.id: view.camera.world_to_cam.double() for view in capture.views}

    def disturb(camera):
        twist = torch.zeros(6, dtype=torch.float64)
        twist[:3] = torch.nn.functional.normalize(torch.randn(3, generator=generator, dtype=torch.float64), dim=0) * np.radians(0.5)
        return replace(camera, world_to_cam=(exp_motion(twist) @ camera.world_to_cam.double()).float())

    disturbed = capture.with_cameras(disturb)
    cfg = config("scaffold-gs", refine_poses=True, iterations=600)
    held: list[Training] = []
    list(events(cfg, folder, world=disturbed, begin=held.append))
    poses = held[0].scene.poses

    def error(cameras):
        found = torch.stack([c.world_to_cam.double()[:3, :3] @ true[c.id][:3, :3].T for c in cameras])
        common = found.mean(0)  # of all cameras, which no picture tells
        return float((found - common).square().sum().sqrt())

    cameras = [disturbed.views[i].camera for i in disturbed.train]
    assert error([poses.refine(c) for c in cameras]) < 0.8 * error(cameras)


def test_the_preview_of_a_training_view_is_from_its_refined_pose(folder):
    capture, rasterize = load(folder, split="none"), choose("auto", "cpu")
    training = Training.start(config("scaffold-gs", refine_poses=True).scaled(), capture, "cpu")
    with torch.no_grad():
        training.scene.poses.motions[0, 4] += 0.05
    run = Job(RunConfig(training.cfg, Data(folder, split="none")))
    shown = preview(training, run, capture, rasterize)
    camera = training.scene.poses.refine(capture.views[capture.train[0]].camera)
    with torch.no_grad():
        decoded = training.scene(camera, training.step, Mode.DRAW, rasterize.visible)
    image = rasterize(decoded.gaussians, camera, torch.tensor(capture.background)).image.clamp(0, 1)
    torch.testing.assert_close(shown.picture, image, rtol=0, atol=1e-6)
