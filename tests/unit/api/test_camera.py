"""Cameras in the capture's own frame."""

from dataclasses import replace

import numpy as np
import pytest
import torch

import scene_experts as se
from scene_experts.api.camera import from_trained, to_trained
from scene_experts.data.views import World

SMALL = se.Camera.look_at((0, 0, 1), (0, 0, 0), width=8, height=8)


def test_a_camera_looks_where_it_is_told():
    camera = se.Camera.look_at((1, 2, 3), (4, 2, 3), (0, 0, 1), width=64, height=48, fov=60)
    assert np.allclose(camera.position, (1, 2, 3)) and camera.fov == pytest.approx(60)
    assert np.allclose(camera.camera_to_world[:3, 2], (1, 0, 0)), "z is forward"
    assert np.allclose(camera.camera_to_world[:3, 1], (0, 0, -1)), "y is down"
    seen = camera.K @ (camera.world_to_camera @ (9, 2, 3, 1))[:3]
    assert np.allclose(seen[:2] / seen[2], (32, 24)), "the target is in the middle"
    above = se.Camera.look_at((0, 0, 5), (0, 0, 0), (0, 0, 1), width=8, height=8)
    assert np.allclose(above.camera_to_world[:3, 2], (0, 0, -1)), "up along the line of sight is replaced"


def test_a_pose_and_intrinsics_make_the_same_camera():
    looking = se.Camera.look_at((1, 2, 3), (0, 0, 0), width=64, height=48, fov=50)
    again = se.Camera.from_pose(looking.camera_to_world[:3].tolist(), width=64, height=48, fx=looking.K[0, 0])
    assert np.allclose(again.world_to_camera, looking.world_to_camera) and np.allclose(again.K, looking.K)
    other = se.Camera.from_pose(np.eye(4), width=64, height=48, fx=50, fy=60, cx=30, cy=20, near=0.5)
    assert other.K.tolist() == [[50, 0, 30], [0, 60, 20], [0, 0, 1]] and other.near == 0.5 and other.view == -1
    assert other.resized(128, 24).K.tolist() == [[100, 0, 60], [0, 30, 10], [0, 0, 1]]


def test_a_rounded_rotation_does_not_move_the_camera():
    pose = np.round(se.Camera.look_at((500, 300, 20), (497, 301, 19), width=64, height=48).camera_to_world, 4)
    camera = se.Camera.from_pose(pose, width=64, height=48, fx=50)
    assert np.allclose(camera.position, (500, 300, 20), rtol=0, atol=1e-9)
    assert np.allclose(camera.camera_to_world, pose, rtol=0, atol=1e-4)


@pytest.mark.parametrize(
    ("make", "said"),
    [
        (lambda: se.Camera.look_at((0, 0, 0), (0, 0, 0), width=8, height=8), "away from the eye"),
        (lambda: se.Camera.look_at((0, 0), (0, 0, 0), width=8, height=8), "eye as three"),
        (lambda: se.Camera.look_at((0, 0, float("nan")), (0, 0, 0), width=8, height=8), "eye as three"),
        (lambda: se.Camera.look_at((0, 0, 1), (0, 0, 0), width=8, height=8, fov=180), "fov"),
        (lambda: se.Camera.look_at((0, 0, 1), (0, 0, 0), width=0, height=8), "px"),
        (lambda: se.Camera.from_pose(2 * np.eye(4), width=8, height=8, fx=9), "rotation"),
        (lambda: se.Camera.from_pose(np.diag([1, 1, -1, 1]), width=8, height=8, fx=9), "rotation"),
        (lambda: se.Camera.from_pose("pose", width=8, height=8, fx=9), "camera_to_world"),  # type: ignore[arg-type]
        (lambda: se.Camera.from_pose(np.eye(4), width=8, height=8, fx=-9), "fx"),
        (lambda: se.Camera.from_pose(np.eye(4), width=8, height=8, fx=9, near=0), "near"),
        (lambda: se.Camera(np.eye(4), np.ones((3, 3)), 8, 8), "K as"),
        (lambda: se.Camera.from_pose(np.eye(4), width="8", height=8, fx=9), "width in px.*'8'"),
        (lambda: se.Camera.from_pose(np.eye(4), width=True, height=8, fx=9), "width in px.*True"),
        (lambda: se.Camera.from_pose(np.eye(4), width=8, height=20_000, fx=9), "16384"),
        (lambda: se.Camera.look_at((0, 0, 1), (0, 0, 0), width=None, height=8), "width in px.*None"),
        (lambda: se.Camera.look_at((0, 0, 1), (0, 0, 0), width=8, height=8, fov="60"), "fov.*'60'"),
        (lambda: replace(SMALL, near="1"), "near.*'1'"),
        (lambda: replace(SMALL, view="a"), "view.*'a'"),
        (lambda: replace(SMALL, view=-5), "view.*-5"),
        (lambda: replace(SMALL, view=1.5), "view.*1.5"),
        (lambda: SMALL.resized(4.5, 4), "width in px.*4.5"),
    ],
)
def test_what_is_no_camera_is_told_in_a_sentence(make, said):
    with pytest.raises(se.InputError, match=said) as error:
        make()
    assert "\n" not in str(error.value)


def test_the_arrays_cannot_be_changed():
    camera = se.Camera.from_pose(np.eye(4), width=8, height=8, fx=9)
    with pytest.raises(ValueError):
        camera.K[0, 0] = 1


def test_a_captured_camera_comes_back_from_the_capture_frame_bit_for_bit(capture):
    world = capture.loaded.world
    assert not world.identity
    for view in capture.loaded.views:
        again = to_trained(from_trained(view.camera, world), world, view.camera.near)
        assert torch.equal(again.world_to_cam, view.camera.world_to_cam) and torch.equal(again.K, view.camera.K)
        assert (again.width, again.height, again.near, again.id) == (
            view.camera.width,
            view.camera.height,
            view.camera.near,
            view.camera.id,
        )


def test_a_near_plane_is_in_the_capture_unit():
    camera = se.Camera.from_pose(np.eye(4), width=8, height=8, fx=9, near=0.5)
    assert to_trained(camera, World(4.0), 0.2).near == 2.0
    assert to_trained(se.Camera.from_pose(np.eye(4), width=8, height=8, fx=9), World(4.0), 0.2).near == 0.2
