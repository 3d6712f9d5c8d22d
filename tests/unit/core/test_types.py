"""Cameras and Gaussians: the conventions that types.py states."""

import math
from dataclasses import replace

import pytest
import torch

from scene_experts.core.types import Camera, Gaussians


def camera() -> Camera:
    pose = torch.eye(4)
    pose[:3, :3] = torch.tensor([[math.cos(0.3), 0, math.sin(0.3)], [0, 1, 0], [-math.sin(0.3), 0, math.cos(0.3)]])
    pose[:3, 3] = torch.tensor([0.5, -1.0, 2.0])
    return Camera(pose, torch.tensor([[50.0, 0, 31], [0, 52, 22], [0, 0, 1]]), 64, 48)


def test_the_position_is_what_the_camera_maps_to_its_origin():
    made = camera()
    torch.testing.assert_close(
        made.world_to_cam @ torch.cat((made.position, torch.ones(1))), torch.tensor([0.0, 0, 0, 1]), atol=1e-6, rtol=0
    )


def test_intrinsics_are_read_from_K_without_mixing_axes():
    assert (camera().fx, camera().fy, camera().cx, camera().cy) == (50.0, 52.0, 31.0, 22.0)


def test_moving_changes_tensors_alone():
    made = camera().to(dtype=torch.float64)
    assert made.K.dtype == made.world_to_cam.dtype == torch.float64
    assert (made.width, made.height, made.near, made.id) == (64, 48, 0.2, 0) and camera().to("cpu").K.dtype == torch.float32


def test_a_pixel_of_a_shrunken_camera_shows_a_block_of_its_own():
    made = replace(camera(), height=49)
    small = made.shrunk(2)
    assert (small.width, small.height, small.near) == (32, 24, made.near) and made.shrunk(2) is small and made.shrunk(1) is made
    point = torch.tensor([0.2, -0.1, 3.0])
    for axis in range(2):
        torch.testing.assert_close((small.K @ point)[axis], (made.K @ point)[axis] / 2)  # in px from the same corner
    assert small.fov == pytest.approx(made.fov, rel=0.03) and (made.fx, made.cx) == (50.0, 31.0)


def test_gaussians_are_counted_by_their_means():
    assert len(Gaussians(*(torch.zeros(7, n) for n in (3, 4, 3)), torch.zeros(7), torch.zeros(7, 3), torch.arange(7))) == 7
    assert len(Gaussians(*(torch.zeros(0, n) for n in (3, 4, 3)), torch.zeros(0), torch.zeros(0, 3), torch.arange(0))) == 0
