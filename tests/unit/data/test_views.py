"""The trained world and its inverse."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from scene_experts.core.types import Camera
from scene_experts.data.capture import load
from scene_experts.data.views import World
from support.synthetic import look_at, make_capture

WORLD = World(3.5, (10.0, -20.0, 0.5))


def camera() -> Camera:
    pose = torch.from_numpy(look_at(np.array([3.0, -2.0, 1.0]), np.array([0.2, 0.1, 0.0]), 0.3))
    K = torch.tensor([[50.0, 0, 31], [0, 52, 22], [0, 0, 1]], dtype=torch.float64)
    return Camera(pose, K, 64, 48, near=0.1)


def test_points_go_there_and_back() -> None:
    xyz = torch.randn(5, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    moved = WORLD.from_input(xyz)
    torch.testing.assert_close(moved, (xyz + torch.tensor([10.0, -20.0, 0.5])) * 3.5)
    torch.testing.assert_close(WORLD.to_input(moved), xyz)


def test_a_moved_camera_sees_the_same_pixels_at_scaled_depth() -> None:
    xyz = torch.randn(9, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(1))
    before, after = camera(), WORLD.camera_from_input(camera())
    a = xyz @ before.world_to_cam[:3, :3].T + before.world_to_cam[:3, 3]
    b = WORLD.from_input(xyz) @ after.world_to_cam[:3, :3].T + after.world_to_cam[:3, 3]
    torch.testing.assert_close(b, 3.5 * a)
    torch.testing.assert_close(WORLD.from_input(before.position), after.position)
    assert after.near == before.near * 3.5
    back = WORLD.camera_to_input(after)
    torch.testing.assert_close(back.world_to_cam, before.world_to_cam)
    assert abs(back.near - before.near) < 1e-12


def test_worlds_compose() -> None:
    xyz = torch.randn(5, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(2))
    second = World(0.2, (1.0, 2.0, 3.0))
    torch.testing.assert_close(WORLD.then(second.shift, second.scale).from_input(xyz), second.from_input(WORLD.from_input(xyz)))
    assert World().identity and not WORLD.identity


def test_a_fingerprint_follows_the_views_their_sizes_and_the_split_not_the_place(tmp_path: Path) -> None:
    for name in ("here", "there"):
        make_capture(tmp_path / name, views=5, size=(24, 16), points=20)
    one = load(tmp_path / "here").fingerprint()
    assert load(tmp_path / "there").fingerprint() == one
    capture = load(tmp_path / "there")
    others = [
        load(tmp_path / "there", resolution="factor:2"),
        load(tmp_path / "there", split="none"),
        replace(capture, views=capture.views[1:]),
    ]
    assert len({one, *(c.fingerprint() for c in others)}) == 4
