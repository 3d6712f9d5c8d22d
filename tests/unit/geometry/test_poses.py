"""Camera poses and their interpolation."""

import itertools
import math

import pytest
import torch

from scene_experts.geometry.poses import catmull_rom, exp_motion, interpolate_poses, log_motion, look_at, make_pose, slerp, with_fov
from scene_experts.geometry.rotation import quat_to_matrix
from support.scenes import CAMERA


def place_of(pose):
    return -(pose[:3, :3].T @ pose[:3, 3])


def test_looking_at_puts_the_target_in_the_middle_with_up_up():
    target, up = torch.tensor([0.0, 0.0, 5.0], dtype=torch.float64), torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
    made = look_at(torch.tensor([4.0, 0.0, 5.0], dtype=torch.float64), target, up)
    seen = made[:3, :3] @ target + made[:3, 3]
    assert torch.allclose(seen, torch.tensor([0.0, 0.0, 4.0], dtype=torch.float64))
    above = made[:3, :3] @ (target + up) + made[:3, 3]
    assert above[1] < 0 and torch.linalg.det(made[:3, :3]) == pytest.approx(1.0)  # y is down in the picture
    straight = look_at(torch.zeros(3, dtype=torch.float64), up, up)
    assert torch.isfinite(straight).all() and torch.linalg.det(straight[:3, :3]) == pytest.approx(1.0)


def test_interpolation_goes_through_its_keys_and_turns_evenly():
    quats = torch.tensor([[math.cos(a / 2), 0, 0, math.sin(a / 2)] for a in (0.0, 1.0, 2.0)], dtype=torch.float64)
    positions = torch.tensor([[0.0, 0, 0], [1, 0, 0], [1, 1, 0]], dtype=torch.float64)
    found = interpolate_poses(positions, quat_to_matrix(quats), 9)
    assert all(torch.allclose(place_of(found[4 * i]), positions[i]) for i in range(3))
    angles = [math.atan2(float(p[0, 1]), float(p[0, 0])) for p in found]  # world-to-camera matrices rotate the other way
    steps = [(b - a) for a, b in itertools.pairwise(angles)]
    assert max(steps) == pytest.approx(min(steps), abs=1e-9) and abs(steps[0]) == pytest.approx(0.25)


def test_a_loop_ends_before_where_it_began():
    angles = [math.pi / 2 * i for i in range(4)]
    positions = torch.tensor([[3 * math.cos(a), 3 * math.sin(a), 1.0] for a in angles], dtype=torch.float64)
    up = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
    rotations = torch.stack([look_at(place, torch.zeros(3, dtype=torch.float64), up)[:3, :3].T for place in positions])
    found = interpolate_poses(positions, rotations, 8, loop=True)
    assert torch.allclose(place_of(found[0]), positions[0]) and torch.allclose(place_of(found[6]), positions[3])
    gaps = [(place_of(b) - place_of(a)).norm() for a, b in zip(found, [*found[1:], found[0]])]
    assert float(max(gaps)) < 2 * float(min(gaps))


def test_slerp_takes_the_shorter_way_and_catmull_rom_its_points():
    a = torch.tensor([1.0, 0, 0, 0], dtype=torch.float64)
    b = torch.tensor([-math.cos(0.1), 0, 0, -math.sin(0.1)], dtype=torch.float64)  # a quaternion and its negative are the same rotation
    half = slerp(a, b, 0.5)
    assert torch.allclose(quat_to_matrix(half), quat_to_matrix(torch.tensor([math.cos(0.05), 0, 0, math.sin(0.05)], dtype=torch.float64)))
    assert torch.allclose(slerp(a, a, 0.3), a)
    p = [torch.tensor([float(i), i * i]) for i in range(4)]
    assert torch.equal(catmull_rom(*p, 0.0), p[1]) and torch.equal(catmull_rom(*p, 1.0), p[2])


def test_a_field_of_view():
    camera = with_fov(CAMERA, math.radians(90), 200, 100)
    assert camera.fy == pytest.approx(50) and (camera.cx, camera.cy) == (100, 50)
    assert make_pose(torch.zeros(3, dtype=torch.float64), torch.eye(3, dtype=torch.float64)).equal(torch.eye(4, dtype=torch.float64))


def test_exp_motion_is_a_rotation_about_an_axis_and_a_translation():
    quarter = exp_motion(torch.tensor([0.0, 0.0, torch.pi / 2, 0.0, 0.0, 0.0], dtype=torch.float64))
    torch.testing.assert_close(
        quarter[:3, :3] @ torch.tensor([1.0, 0, 0], dtype=torch.float64), torch.tensor([0.0, 1, 0], dtype=torch.float64)
    )
    moved = exp_motion(torch.tensor([0.0, 0, 0, 1, 2, 3], dtype=torch.float64))
    assert torch.equal(moved[:3, 3], torch.tensor([1.0, 2, 3], dtype=torch.float64))


def test_the_twist_of_a_motion_is_found_again():
    twist = torch.tensor([0.4, -1.2, 0.7, 3.0, 0.1, -2.0], dtype=torch.float64)
    assert torch.allclose(log_motion(exp_motion(twist)), twist)
    assert torch.allclose(log_motion(torch.eye(4)), torch.zeros(6, dtype=torch.float64))
