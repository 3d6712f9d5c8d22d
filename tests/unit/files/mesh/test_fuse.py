"""Signed distances: of a plane and a sphere that are known, and what is left out of depths."""

import numpy as np
import pytest
import torch

from scene_experts.core.types import Camera
from scene_experts.files.mesh.fuse import SIDE, TRUNCATION, DepthView, clean, find_blocks, fuse, sample, see_points
from support.meshes import around, sphere_view


def test_faint_pixels_and_outlines_have_no_depth():
    depth, alpha = np.full((6, 8), 2.0, np.float32), np.ones((6, 8), np.float32)
    depth[:, 5:] = 4.0
    depth[1, 1], alpha[1, 1] = 1.9, 0.95
    alpha[4, 2] = 0.5
    found = clean(depth, alpha)
    assert found[1, 1] == pytest.approx(2.0) and (found[:, [4, 5]] == 0).all() and (found[2, [0, 7]] == [2.0, 4.0]).all()
    assert found[4, 2] == 0 and found[3, 2] == 0, "its neighbours border on nothing"


def test_points_and_depths_are_those_of_the_surface():
    view = sphere_view((3.0, 1.0, 0.5))
    points = see_points(view)
    np.testing.assert_allclose(np.linalg.norm(points, axis=1), 1, atol=1e-5)
    assert len(see_points(view, 2)) < len(points) / 3
    at, seen = sample(view, points)
    z = points @ view.camera.world_to_cam.double().numpy()[2, :3] + float(view.camera.world_to_cam[2, 3])
    assert seen.mean() > 0.8
    np.testing.assert_allclose(at[seen], z[seen], atol=1e-5)
    behind = sample(view, np.array([[6.0, 2.0, 1.0]]))
    assert not behind[1].any()


def test_blocks_hold_everything_within_the_truncation():
    points, origin, voxel = np.array([[0.0, 0.0, 0.0], [1.0, 2.0, -1.0]]), np.array([-3.0, -3.0, -3.0]), 0.1
    blocks = {tuple(block) for block in find_blocks(points, origin, voxel)}
    rng = np.random.default_rng(0)
    for point in points:
        near = point + TRUNCATION * voxel * rng.uniform(-1, 1, (200, 3))
        assert {tuple(block) for block in np.floor((near - origin) / (SIDE * voxel)).astype(int)} <= blocks


def test_distances_are_those_to_a_sphere():
    views = around(12)
    voxel, origin = 0.06, np.full(3, -1.3)
    blocks = find_blocks(np.concatenate([see_points(view) for view in views]), origin, voxel)
    told: list[tuple[int, int]] = []
    volume = fuse(views, blocks, origin, voxel, lambda done, total: told.append((done, total)))
    assert told[-1] == (len(blocks),) * 2
    inside = np.stack(np.meshgrid(*[np.arange(SIDE)] * 3, indexing="ij"), -1)
    radius = np.linalg.norm(origin + voxel * (SIDE * blocks[:, None, None, None] + inside), axis=-1)
    near = (volume.weight >= 3) & (np.abs(radius - 1) < voxel)
    assert near.sum() > 300
    # along z of a slanted view the surface is further away than straight down
    assert (np.sign(volume.distance[near]) == np.sign(radius[near] - 1)).mean() > 0.93
    far = (volume.weight >= 1) & (radius > 1 + 1.8 * TRUNCATION * voxel)
    assert (volume.distance[far] == 1).all()


def test_a_voxel_behind_a_surface_is_not_seen():
    camera = Camera(torch.eye(4), torch.tensor([[20.0, 0, 10], [0, 20, 10], [0, 0, 1]]), 20, 20)
    view = DepthView(camera, np.full((20, 20), 2.0, np.float32), np.zeros((20, 20, 3), np.float32))
    volume = fuse([view], np.array([[0, 0, k] for k in range(4)]), np.array([-0.4, -0.4, 0.4]), 0.1)
    z = 0.4 + 0.1 * np.arange(32)
    weight, distance = volume.weight[:, 4, 4].ravel(), volume.distance[:, 4, 4].ravel()
    assert ((z < 2 + TRUNCATION * 0.1 + 1e-6) == (weight > 0)).all()
    np.testing.assert_allclose(distance[weight > 0], np.minimum((2 - z[weight > 0]) / (TRUNCATION * 0.1), 1), atol=1e-5)
