"""The 3D smoothing filter of Mip-Splatting."""

import math
from dataclasses import replace

import pytest
import torch

from scene_experts.core.types import Camera, Decoded, Gaussians, Mode
from scene_experts.geometry.rotation import covariance
from scene_experts.render import choose
from scene_experts.scene import restore_scene
from scene_experts.scene.anchors.smoothing import find_intervals, smooth
from scene_experts.training.recipes import RECIPES
from support.scenes import CAMERA, start_scene


def camera(distance, focal):
    pose = torch.eye(4)
    pose[2, 3] = distance
    return Camera(pose, torch.tensor([[focal, 0, 24], [0, focal, 16], [0, 0, 1.0]]), 48, 32, 0.2)


def test_intervals_are_the_finest_of_the_views_that_see_a_point():
    points = torch.tensor([[0.0, 0, 0], [2.0, 0, 0], [0, 0, -4.5], [50.0, 0, 0]])
    near, far = camera(4.0, 40.0), camera(10.0, 50.0)
    found = find_intervals(points, [near, far])
    # (2, 0, 0) is at column 44 of the near view; (0, 0, -4.5) is behind it; (50, 0, 0) is outside of both.
    torch.testing.assert_close(found, torch.tensor([0.1, 0.1, 5.5 / 50, 5.5 / 50]))
    edge = torch.tensor([[(1.14 * 48 - 24) / 10, 0, 0], [(1.16 * 48 - 24) / 10, 0, 0]])  # 15 % outside still counts
    torch.testing.assert_close(find_intervals(edge, [near, far]), torch.tensor([0.1, 0.2]))
    assert find_intervals(points, []).tolist() == [0, 0, 0, 0]


def made(scales, opacities):
    g = torch.Generator().manual_seed(0)
    quats = torch.nn.functional.normalize(torch.randn(len(scales), 4, generator=g, dtype=torch.float64), dim=1)
    source = torch.arange(len(scales))
    gaussians = Gaussians(torch.zeros_like(scales), quats, scales, opacities, torch.zeros_like(scales), source)
    return Decoded(gaussians, source // 2, None, {})


def test_the_filter_adds_its_variance_and_keeps_the_integral_of_each_gaussian():
    scales, opacities = torch.rand(6, 3, dtype=torch.float64) + 0.01, torch.rand(6, dtype=torch.float64)
    intervals = torch.tensor([0.5, 1.0, 0.0], dtype=torch.float64)
    before, after = made(scales, opacities).gaussians, smooth(made(scales, opacities), intervals, 0.2, 2).gaussians
    wide = 0.2 * intervals[torch.arange(6) // 2] ** 2
    sigma, expected = covariance(after.quats, after.scales), covariance(before.quats, before.scales) + wide[:, None, None] * torch.eye(3)
    torch.testing.assert_close(sigma, expected)
    torch.testing.assert_close(after.opacities, opacities * (before.scales.prod(1).square() / torch.linalg.det(expected)).sqrt())
    assert torch.equal(after.scales[4:], scales[4:]) and torch.equal(after.opacities[4:], opacities[4:])
    assert smooth(made(scales, opacities), None, 0.2, 2).gaussians.scales is scales


def test_gradients_are_those_of_finite_differences():
    intervals = torch.tensor([0.5, 1.0], dtype=torch.float64)

    def run(scales, opacities):
        g = smooth(made(scales, opacities), intervals, 0.2, 2).gaussians
        return g.scales, g.opacities

    inputs = [(torch.rand(4, n, dtype=torch.float64) + 0.1).squeeze(1).requires_grad_() for n in (3, 1)]
    assert torch.autograd.gradcheck(run, inputs)


@pytest.mark.parametrize("recipe", ["scaffold-gs", "moe-gs", "octree-gs"])
def test_every_draw_of_a_scene_smooths_and_new_anchors_have_an_interval(recipe):
    scene, cull = start_scene(recipe), choose("auto", "cpu").visible
    scene.set_training_cameras([CAMERA])
    assert "interval" not in scene.table.facts  # off
    plain = scene(CAMERA, 2000, Mode.DRAW, cull).gaussians
    scene.config = replace(scene.config, smoothing=0.2)
    scene.set_training_cameras([CAMERA])
    intervals = scene.table.facts["interval"]
    assert intervals.min() > 0
    found = scene(CAMERA, 2000, Mode.DRAW, cull).gaussians
    assert torch.equal(found.source, plain.source) and (found.scales > plain.scales).all() and (found.opacities < plain.opacities).all()
    again = scene.frozen(2000)(CAMERA, 2000, Mode.DRAW, cull).gaussians
    torch.testing.assert_close(again.scales, found.scales)
    new = scene.new_rows(torch.tensor([[0, 0, round(4 / scene.voxel)]]), 0.1, torch.zeros(1, scene.config.F))
    scene.table.append(new)
    assert 0 < float(scene.table.facts["interval"][-1]) < math.inf


def test_a_checkpoint_keeps_the_intervals():
    scene = start_scene("moe-gs")
    scene.config = replace(scene.config, smoothing=0.2)
    scene.set_training_cameras([CAMERA])
    tensors = {f"params.{k}": v.detach() for k, v in scene.table.params.items()} | {f"facts.{k}": v for k, v in scene.table.facts.items()}
    tensors |= {f"network.{k}": v.detach() for k, v in scene.network_tensors().items()}
    other = restore_scene(replace(RECIPES["moe-gs"][1].scene, smoothing=0.2), tensors, scene.meta())
    assert torch.equal(other.table.facts["interval"], scene.table.facts["interval"])
