"""The trained world and its inverse."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from scene_experts.core.types import Camera
from scene_experts.data.views import World, same_poses, typical_size
from support.captures import load
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


def test_poses_are_those_of_the_captures_own_frame_and_tell_other_frames_apart(tmp_path) -> None:
    def poses(name: str, **how) -> str:
        capture = load(make_capture(tmp_path / name, **{"views": 7, "size": (16, 12), "points": 20, **how}).folder, split="none")
        capture.images.close()
        return capture.poses()

    found = poses("one")
    rows = np.array([[float(word) for word in row.split()] for row in found.split(";")])
    folder = tmp_path / "one"
    capture = load(folder)
    for row, view in zip(rows, (capture.views[i] for i in (0, 2, 4, 6)), strict=True):
        camera = capture.world.camera_to_input(view.camera)
        np.testing.assert_allclose(row[:3], camera.position, atol=1e-5)
        np.testing.assert_allclose(row[3:], camera.world_to_cam[[2, 1], :3].flatten(), atol=1e-4)
    capture.images.close()
    far = make_capture(tmp_path / "far", views=7, size=(16, 12), points=20, scale=300.0).folder
    one, two = load(far), load(far, normalise="none")
    assert one.world != two.world and same_poses(one.poses(), two.poses()) and not same_poses(found, one.poses())
    for other in ({"scale": 2.0}, {"scale": 1.01}, {"seed": 1}, {"views": 8}, {"views": 1}):
        assert not same_poses(found, poses(str(other), **other)), other
    assert same_poses(found, poses("again"))
    near = "; ".join(" ".join(f"{float(word) + 1e-4}" for word in row.split()) for row in found.split(";"))
    assert same_poses(found, near)
    for unknown in ("", None, 3, "a b", "1 2; 3", "nan " * 9, "1 " * 5000):
        assert same_poses(found, unknown) and same_poses(unknown, found)
    single = poses("single", views=1)
    assert single.count(";") == 0 and same_poses(single, single) and not same_poses(single, poses("single moved", views=1, scale=2.0))


def test_other_cameras_leave_the_poses_by_which_a_capture_is_known(tmp_path):
    capture = load(make_capture(tmp_path / "capture", views=3, size=(24, 16), points=20).folder)
    moved = capture.with_cameras(lambda c: replace(c, world_to_cam=c.world_to_cam + 1))
    assert torch.equal(moved.views[1].camera.world_to_cam, capture.views[1].camera.world_to_cam + 1)
    assert moved.poses() == capture.poses() == moved.with_cameras(lambda c: c).poses()


def test_the_typical_size_is_that_of_most_photographs():
    assert typical_size([(300, 199), (1200, 797), (797, 1200), (1200, 797)]) in [(1200, 797), (797, 1200)]
    assert typical_size([(4, 3)]) == (4, 3)
