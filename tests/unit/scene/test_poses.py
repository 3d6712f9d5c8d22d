"""Refined poses: the gradient of a pose, what is taken out of the motions, and checkpoints."""

from dataclasses import replace

import pytest
import torch

from scene_experts.core.types import Gaussians
from scene_experts.geometry.poses import exp_motion
from scene_experts.geometry.rotation import normalise_quats
from scene_experts.render import choose
from scene_experts.render.reference import ReferenceRasterizer
from scene_experts.scene.poses import BEGIN, FULL, RATE, Poses, at_pose, attach, find_gauge, pose_gradient, skew
from support.scenes import CAMERA

EXTENT = 3.0


def camera_at(id, seed, dtype=torch.float32):
    motion = 0.2 * torch.randn(6, dtype=torch.float64, generator=torch.Generator().manual_seed(seed))
    return replace(CAMERA, world_to_cam=exp_motion(motion).to(dtype), id=id)


def gaussians(dtype=torch.float64, n=40):
    made = torch.Generator().manual_seed(1)
    normal = lambda *shape: torch.randn(*shape, generator=made, dtype=torch.float64)  # noqa: E731
    means = normal(n, 3) * 0.6 + torch.tensor([0.0, 0, 4])
    values = (
        means,
        normalise_quats(normal(n, 4)),
        (normal(n, 3) * 0.3 - 1.5).exp(),
        torch.rand(n, generator=made) * 0.8 + 0.1,
        normal(n, 3).abs(),
    )
    return Gaussians(*(v.to(dtype) for v in values), torch.arange(n))


def weights():
    return torch.randn(CAMERA.height, CAMERA.width, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(2))


def loss_at(motion, rasterize=None, dtype=torch.float64):
    """The loss of a picture whose camera moves by a twist [6], the whole graph through the pose."""
    camera = camera_at(0, 3, dtype)
    moved = replace(camera, world_to_cam=(exp_motion(motion) @ camera.world_to_cam.double()).to(dtype))
    return ((rasterize or ReferenceRasterizer())(gaussians(dtype), moved, torch.zeros(3, dtype=dtype)).image * weights()).sum()


def gradient_by_attach(motion, rasterize, dtype):
    camera, motion = camera_at(0, 3, dtype), motion.clone().requires_grad_()
    pose = exp_motion(motion) @ camera.world_to_cam.double()
    g = attach(gaussians(dtype), pose)
    (rasterize(g, at_pose(camera, pose), torch.zeros(3, dtype=dtype)).image * weights()).sum().backward()
    return motion.grad


@pytest.mark.parametrize("size", [0.0, 0.1])
def test_the_gradient_of_a_pose_is_that_of_the_reference_and_of_differences(size):
    motion = size * torch.tensor([0.5, -0.3, 0.8, 0.4, 0.6, -0.7], dtype=torch.float64)
    found = gradient_by_attach(motion, ReferenceRasterizer(), torch.float64)
    whole = motion.clone().requires_grad_()
    loss_at(whole).backward()
    torch.testing.assert_close(found, whole.grad, rtol=1e-9, atol=1e-9)
    step = 1e-6 * torch.eye(6, dtype=torch.float64)
    differences = torch.stack([(loss_at(motion + d) - loss_at(motion - d)) / 2e-6 for d in step])
    torch.testing.assert_close(found, differences, rtol=1e-3, atol=1e-2 * float(differences.abs().max()))


def test_the_compiled_rasteriser_gives_the_same_gradient():
    motion = torch.zeros(6, dtype=torch.float64)
    reference = gradient_by_attach(motion, ReferenceRasterizer(), torch.float64)
    fast = gradient_by_attach(motion, choose("cpu", "cpu"), torch.float32)
    torch.testing.assert_close(fast, reference, rtol=1e-3, atol=1e-3 * float(reference.abs().max()))


def test_the_gradient_is_the_same_at_any_number_of_threads():
    n, made = 100_000, torch.Generator().manual_seed(0)
    values = [torch.randn(n, width, generator=made) for width in (3, 4, 3, 4)]
    before, found = torch.get_num_threads(), []
    try:
        for threads in (1, 2, 5):
            torch.set_num_threads(threads)
            found.append(pose_gradient(*values, torch.eye(4, dtype=torch.float64)))
    finally:
        torch.set_num_threads(before)
    assert torch.equal(found[0], found[1]) and torch.equal(found[0], found[2])


def test_attached_gaussians_are_the_same_and_pass_their_gradients():
    g = gaussians()
    g = replace(g, means=g.means.requires_grad_())
    seen = attach(g, torch.eye(4, dtype=torch.float64).requires_grad_())
    assert torch.equal(seen.means, g.means) and torch.equal(seen.quats, g.quats)
    seen.means.sum().backward()
    assert torch.equal(g.means.grad, torch.ones_like(g.means))


def poses(n=5):
    return Poses([camera_at(3 * i, i) for i in range(n)], EXTENT)


def test_a_motion_or_scaling_of_the_world_is_taken_out():
    made = poses()
    assert made.gauge.shape == (5, 6, 7)
    small = 1e-4
    turn, shift, growth = torch.tensor([1.0, 2, -1]), torch.tensor([0.5, -1, 2]), 0.7
    rows = []
    for i in range(5):  # the pose after x' = x + small (turn x x + shift + growth x), from the corresponding points
        pose = camera_at(3 * i, i).world_to_cam.double()
        world = torch.eye(4, dtype=torch.float64)
        world[:3, :3] += small * skew(turn.double())
        world[:3, 3] = small * shift.double()
        centre = -pose[:3, :3].T @ pose[:3, 3]
        moved = pose @ world
        moved[:3, 3] -= pose[:3, :3] @ (world[:3, :3] @ (-small * growth * centre))
        change = (moved @ torch.linalg.inv(pose) - torch.eye(4, dtype=torch.float64)) / small
        rows.append(torch.cat([torch.stack([change[2, 1], change[0, 2], change[1, 0]]), change[:3, 3] / EXTENT]))
    with torch.no_grad():
        made.motions.copy_(torch.stack(rows))
    assert made.motions.detach().abs().max() > 0.1
    assert made.without_gauge().detach().abs().max() < 1e-3


def test_other_motions_stay_and_held_out_cameras_do_not_move():
    made = poses(30)
    with torch.no_grad():
        made.motions.normal_(0, 0.01, generator=torch.Generator().manual_seed(0))
    kept = made.without_gauge()
    assert (kept - made.motions).detach().norm() < 0.4 * made.motions.detach().norm()
    camera = camera_at(3, 1)
    pose = made.pose_of(camera)
    expected = exp_motion(torch.cat([kept[1, :3], kept[1, 3:] * EXTENT]).double()) @ camera.world_to_cam.double()
    torch.testing.assert_close(pose, expected)
    refined = made.refine(camera)
    assert torch.equal(refined.world_to_cam, pose.float()) and refined.id == camera.id and refined.pinhole == camera.pinhole
    assert made.refine(camera_at(4, 1)).world_to_cam.equal(camera_at(4, 1).world_to_cam)
    assert "degrees" in made.describe()


def test_poses_begin_at_adjusted_cameras_and_keep_what_moves_all_of_them():
    made, given = poses(), [camera_at(3 * i, i) for i in range(5)]
    world = exp_motion(torch.tensor([0.02, 0.01, -0.01, 0.1, 0.2, 0.0], dtype=torch.float64))  # a motion of the whole world
    adjusted = [at_pose(camera, camera.world_to_cam.double() @ world) for camera in given]
    made.begin_at(given, adjusted)
    for camera, other in zip(given, adjusted):
        torch.testing.assert_close(made.refine(camera).world_to_cam, other.world_to_cam, rtol=0, atol=1e-5)
    again = Poses.restore(made.tensors())
    assert again is not None and torch.equal(again.without_gauge(), made.without_gauge())
    later = poses()
    later.continue_from(made)
    torch.testing.assert_close(later.without_gauge(), made.without_gauge())


def test_poses_start_where_they_are():
    camera = camera_at(6, 2)
    assert torch.equal(poses().refine(camera).world_to_cam, camera.world_to_cam)


@pytest.mark.parametrize("n", [1, 2])
def test_few_cameras_have_fewer_motions_of_the_world(n):
    basis = find_gauge([camera_at(i, i) for i in range(n)], EXTENT)
    assert basis.shape[2] == min(6 * n, 7)
    flat = basis.reshape(6 * n, -1)
    torch.testing.assert_close(flat.T @ flat, torch.eye(flat.shape[1], dtype=torch.float64))


def test_checkpoints_hold_all():
    made = poses()
    with torch.no_grad():
        made.motions.normal_()
    restored = Poses.restore(made.tensors())
    assert restored.row == made.row
    assert torch.equal(restored.without_gauge(), made.without_gauge())
    assert Poses.restore({}) is None
    later = Poses([camera_at(3 * i, i) for i in range(2, 8)], EXTENT)
    later.continue_from(made)
    assert torch.equal(later.motions[0], made.without_gauge()[2]) and not later.motions[4].any()


def test_the_rate_rises_after_the_beginning():
    made = poses()
    assert made.learning_rate(int(BEGIN * 1000), 1000) == 0
    assert made.learning_rate(int(FULL * 1000), 1000) == pytest.approx(RATE.at(int(FULL * 1000), 1000))
    assert made.learning_rate(1000, 1000) < made.learning_rate(500, 1000)
