"""Displaced viewing positions and dropped anchors, from their formulas."""

import math
from dataclasses import replace

import pytest
import torch

from scene_experts.core.errors import InputError
from scene_experts.core.fields import check_fields
from scene_experts.core.types import Camera, Mode, Points
from scene_experts.scene.anchors.few_views import displace, find_spacings, find_weight, left_at
from scene_experts.scene.anchors.scene import Anchors, AnchorScene
from support.messages import naming

EVERYTHING = lambda means, scales, camera: torch.ones(len(means), dtype=torch.bool)  # noqa: E731


def camera(x: float = 0.0, name: int = 0) -> Camera:
    angle = 0.3 + x
    pose = torch.eye(4)
    pose[0, 0] = pose[2, 2] = math.cos(angle)
    pose[0, 2], pose[2, 0] = math.sin(angle), -math.sin(angle)
    pose[:3, 3] = -(pose[:3, :3] @ torch.tensor([x, 0.2, -6.0]))
    return Camera(pose, torch.tensor([[80.0, 0, 40], [0, 80, 30], [0, 0, 1]]), 80, 60, id=name)


def scene(config: Anchors, cameras: list[Camera]) -> AnchorScene:
    torch.manual_seed(0)
    xyz = torch.rand(500, 3, dtype=torch.float64) * 2 - 1
    made = AnchorScene.from_points(replace(config, voxel_size=0.01), Points(xyz, torch.zeros(500, 3, dtype=torch.uint8)), 5.0)
    made.table.params["feature"].data.normal_()
    made.set_training_cameras(cameras)
    return made


def test_spacing_is_the_mean_distance_to_the_two_nearest_cameras():
    places = (0.0, 1.0, 3.0, 7.0)
    found = find_spacings([camera(x, 10 + i) for i, x in enumerate(places)])
    assert found == pytest.approx({10: (1 + 3) / 2, 11: (1 + 2) / 2, 12: (2 + 3) / 2, 13: (4 + 6) / 2}, rel=1e-5)


@pytest.mark.parametrize(("places", "expected"), [((4.0,), [0.0]), ((1.0, 3.5), [2.5, 2.5]), ((2.0, 2.0, 2.0), [0.0] * 3)])
def test_spacing_of_few_cameras(places, expected):
    found = find_spacings([camera(x, i) for i, x in enumerate(places)])
    assert list(found.values()) == pytest.approx(expected, abs=1e-5)


def test_displacement_is_isotropic_and_has_the_distance_as_root_mean_square():
    torch.manual_seed(0)
    start = camera(0.5)
    moved = torch.stack([displace(start, 0.6).position - start.position for _ in range(4000)])
    assert float(moved.square().sum(1).mean().sqrt()) == pytest.approx(0.6, rel=0.03)
    assert (torch.cov(moved.T) - 0.6**2 / 3 * torch.eye(3)).abs().max() < 0.01
    assert moved.mean(0).abs().max() < 0.03
    other = displace(start, 0.6)
    assert torch.equal(other.world_to_cam[:3, :3], start.world_to_cam[:3, :3])
    assert (other.id, other.width, other.near) == (start.id, start.width, start.near)


@pytest.mark.parametrize("decode", ["composed", "auto"])
def test_a_training_view_is_decoded_from_the_displaced_position_and_drawn_from_its_own(decode):
    cameras = [camera(x, i) for i, x in enumerate((0.0, 0.5, 2.0))]
    made = scene(Anchors(view_jitter=0.5, decode=decode), cameras)
    torch.manual_seed(3)
    found = made(cameras[1], 1, Mode.TRAIN, EVERYTHING)
    torch.manual_seed(3)
    expected = made.decode_composed(torch.arange(len(made.table)), displace(cameras[1], 0.5 * (0.5 + 1.5) / 2), 1, Mode.TRAIN)
    assert torch.allclose(found.raw_opacity, expected.raw_opacity, atol=1e-6)
    assert not torch.allclose(found.raw_opacity, made.decode_composed(found.rows, cameras[1], 1, Mode.TRAIN).raw_opacity, atol=1e-3)

    seen = []
    made(cameras[1], 1, Mode.TRAIN, lambda means, scales, camera: seen.append(camera) or torch.ones(len(means), dtype=torch.bool))
    assert torch.equal(seen[0].position, cameras[1].position)  # the culling looks from the camera


def test_held_out_views_are_not_displaced():
    cameras = [camera(x, i) for i, x in enumerate((0.0, 0.5, 2.0))]
    made, plain = scene(Anchors(view_jitter=0.5), cameras), scene(Anchors(), cameras)
    assert torch.equal(made(cameras[0], 1, Mode.DRAW, EVERYTHING).raw_opacity, plain(cameras[0], 1, Mode.DRAW, EVERYTHING).raw_opacity)


def test_displaced_gradients_are_those_of_the_formula():
    cameras = [camera(x, i) for i, x in enumerate((0.0, 0.5, 2.0))]
    made = scene(Anchors(view_jitter=0.5), cameras)
    torch.manual_seed(5)
    made(cameras[0], 1, Mode.TRAIN, EVERYTHING).raw_opacity.sum().backward()
    feature = made.table.params["feature"]
    found, feature.grad = feature.grad.clone(), None
    torch.manual_seed(5)
    made.decode_composed(torch.arange(500), displace(cameras[0], 0.5 * 1.25), 1, Mode.TRAIN).raw_opacity.sum().backward()
    assert torch.allclose(found, feature.grad, atol=1e-5)


@pytest.mark.parametrize(
    ("views", "few", "expected"), [(20, 0, 1), (500, 0, 1), (5, 20, 1), (20, 20, 1), (25, 20, 0.75), (40, 20, 0), (99, 20, 0)]
)
def test_weight_of_dropout_and_displacement(views, few, expected):
    assert find_weight(few, views) == expected


def test_more_views_mean_less_dropout_and_less_displacement():
    cameras = [camera(0.1 * i, i) for i in range(8)]
    made = scene(Anchors(dropout=0.4, dropout_full=1, few_views=5), cameras)
    kept = [len(made(cameras[0], 1, Mode.TRAIN, EVERYTHING).rows) / 500 for _ in range(50)]
    assert sum(kept) / 50 == pytest.approx(1 - 0.4 * (2 - 8 / 5), abs=0.02)

    few, plain = scene(Anchors(view_jitter=0.5, few_views=5), cameras), scene(Anchors(view_jitter=0.5 * (2 - 8 / 5)), cameras)
    many = scene(Anchors(view_jitter=0.5, dropout=0.4, dropout_full=1, few_views=4), cameras)
    assert torch.equal(many(cameras[0], 1, Mode.TRAIN, EVERYTHING).raw_opacity, many(cameras[0], 1, Mode.DRAW, EVERYTHING).raw_opacity)
    opacities = []
    for each in (few, plain):
        torch.manual_seed(7)
        opacities.append(each(cameras[2], 1, Mode.TRAIN, EVERYTHING).raw_opacity)
    assert torch.allclose(*opacities, atol=1e-6)


@pytest.mark.parametrize("changes", [{"view_jitter": -0.1}, {"few_views": -1}])
def test_refused(changes):
    with pytest.raises(InputError, match=naming("--scene." + next(iter(changes)).replace("_", "-"))):
        check_fields(Anchors(**changes), "scene")


@pytest.mark.parametrize(("step", "expected"), [(1, 1.0), (10, 1.0), (15, 0.75), (20, 0.5), (30, 0.0), (99, 0.0)])
def test_both_fall_to_nothing_between_two_iterations(step, expected):
    assert left_at(step, 10, 30) == pytest.approx(expected) and left_at(step, 0, 0) == 1.0
    assert left_at(30, 30, 30) == 0.0 and left_at(29, 30, 30) == 1.0
    cameras = [camera(float(i), i) for i in range(3)]
    falling = scene(Anchors(dropout=0.4, dropout_full=1, view_jitter=0.5, few_fall=(10, 30)), cameras)
    steady = scene(Anchors(dropout=0.4 * expected, dropout_full=1, view_jitter=0.5 * expected), cameras)
    found = []
    for made in (falling, steady):
        torch.manual_seed(1)
        rows, seen_from = made.choose(cameras[0], step, Mode.TRAIN, EVERYTHING)
        found.append((rows, seen_from.world_to_cam))
        drawn, at = made.choose(cameras[0], step, Mode.DRAW, EVERYTHING)
        assert len(drawn) == len(made.table) and at is cameras[0]
    assert all(torch.equal(a, b) for a, b in zip(*found))


def test_the_fall_is_rescaled_with_the_training():
    from scene_experts.training.recipes import RECIPES

    cfg = replace(RECIPES["scaffold-gs"][1], iterations=3000, scene=Anchors(few_fall=(15_000, 22_500)))
    assert cfg.scaled().scene.few_fall == (1500, 2250)
