"""Triangles: of a sphere that is known, across the chunks of a volume, and their colours."""

import numpy as np
import pytest

from scene_experts.files.mesh.fuse import find_blocks, fuse, see_points
from scene_experts.files.mesh.surface import colour, find_surface, leave_out_small, merge
from support.meshes import around

pytest.importorskip("skimage")
VOXEL = 0.04


@pytest.fixture(scope="module")
def sphere():
    views, origin = around(16), np.full(3, -64 * VOXEL)  # four chunks meet at 0
    volume = fuse(views, find_blocks(np.concatenate([see_points(view) for view in views]), origin, VOXEL), origin, VOXEL)
    return views, *find_surface(volume, len(views))


def test_a_sphere_is_found_and_faces_outwards(sphere):
    _, vertices, faces = sphere
    assert np.abs(np.linalg.norm(vertices, axis=1) - 1).max() < 0.5 * VOXEL
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    normal = np.cross(b - a, c - a)
    assert ((normal * (a + b + c)).sum(1) > 0).mean() > 0.999
    area = np.linalg.norm(normal, axis=1).sum() / 2
    assert area == pytest.approx(4 * np.pi, rel=0.12)  # some is seen by too few views


def test_chunks_join_without_seams(sphere):
    _, vertices, faces = sphere
    edges = np.sort(np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), axis=1)
    found, times = np.unique(edges, axis=0, return_counts=True)
    assert times.max() == 2
    for axis in range(3):  # edges between chunks are as rarely open as others: some of the sphere is seen by too few views
        between = (np.abs(vertices[found][:, :, axis]) < 1e-9).all(1)
        assert between.sum() > 100 and (times[between] == 2).mean() >= (times == 2).mean() - 0.01


def test_equal_vertices_become_one_and_the_unused_go():
    vertices = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1e-5, 0], [5, 5, 5], [1, 1, 0]])
    found, faces = merge(vertices, np.array([[0, 1, 2], [3, 5, 2], [1, 3, 2]]))
    assert len(found) == 4 and len(faces) == 2
    np.testing.assert_allclose(np.sort(found[faces].reshape(2, -1).sum(1)), [2, 4], atol=1e-4)


def test_small_parts_go():
    vertices = np.random.default_rng(0).normal(size=(43, 3))
    fan = np.array([[0, i, i + 1] for i in range(1, 39)])
    found, faces = leave_out_small(vertices, np.concatenate([fan, [[40, 41, 42]]]), smallest=0.05)
    assert len(found) == 40 and len(faces) == len(fan)
    assert len(leave_out_small(vertices, np.zeros((0, 3), np.int64))[1]) == 0


def test_vertices_have_the_colour_that_views_see_there(sphere):
    views, vertices, _ = sphere
    assert (colour(vertices, views, VOXEL) == 64).mean() > 0.98
    unseen = np.array([[0.0, 0.0, 0.0]])
    assert (colour(unseen, views, VOXEL) == 128).all()
    assert (colour(np.concatenate([vertices, unseen]), views, VOXEL)[-1] == 64).all()
