"""Triangles of a volume's surface, and their colours.

Marching cubes (scikit-image) runs on chunks of the volume, which share their outer voxels, so that
the triangles of neighbouring chunks meet.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import KDTree

from scene_experts.files.mesh.fuse import SIDE, DepthView, Points, Volume, sample

CHUNK = 8  # blocks of a chunk's edge
SMALLEST = 0.001  # connected parts with less than this share of all triangles are left out
LEAST_VIEWS = 2  # that a voxel needs to bear a surface
_ALIKE = 1e-3  # voxels; vertices closer than this are one
_AGREES = 1.5  # voxels; a view colours a vertex if what it sees there is no further away


@dataclass(frozen=True)
class Mesh:
    """Coloured triangles."""

    vertices: Points
    """[V, 3]"""
    faces: NDArray[np.int64]
    """[F, 3] vertices, counter-clockwise seen from outside."""
    colors: NDArray[np.uint8]
    """[V, 3] RGB."""

    def __len__(self) -> int:
        return len(self.faces)

    def __str__(self) -> str:
        return f"{len(self.faces):,} triangles, {len(self.vertices):,} vertices"


def find_surface(volume: Volume, views: int) -> tuple[Points, NDArray[np.int64]]:
    """Return the vertices [V, 3] and triangles [F, 3] where the distance is 0, without small parts.

    views: Number of views of the volume; voxels that too few have seen bear no surface.
    """
    from skimage.measure import marching_cubes

    least, size = min(LEAST_VIEWS, views), CHUNK * SIDE + 1
    found, faces, count = [], [], 0
    places = {tuple(block): i for i, block in enumerate(volume.blocks.tolist())}
    for chunk in np.unique(np.floor_divide(volume.blocks, CHUNK), axis=0):
        distance, weight = np.ones((size,) * 3, np.float32), np.zeros((size,) * 3, np.float32)
        for x, y, z in np.ndindex(*(CHUNK + 1,) * 3):
            i = places.get((chunk[0] * CHUNK + x, chunk[1] * CHUNK + y, chunk[2] * CHUNK + z))
            if i is not None:
                to = tuple(slice(SIDE * k, min(SIDE * (k + 1), size)) for k in (x, y, z))
                cut = tuple(slice(0, s.stop - s.start) for s in to)
                distance[to], weight[to] = volume.distance[i][cut], volume.weight[i][cut]
        known = weight >= least
        if not known.any() or distance[known].min() >= 0:
            continue
        distance[~known] = 1
        vertices, triangles = marching_cubes(distance, 0.0, gradient_direction="descent", allow_degenerate=False)[:2]
        cell = np.floor(vertices[triangles].mean(1)).astype(np.int64).clip(0, size - 2)
        triangles = triangles[_all_corners(known)[tuple(cell.T)]]
        found.append(vertices + SIDE * CHUNK * chunk)
        faces.append(triangles + count)
        count += len(vertices)
    if not count:
        return np.zeros((0, 3)), np.zeros((0, 3), np.int64)
    vertices, triangles = merge(np.concatenate(found), np.concatenate(faces))
    vertices, triangles = leave_out_small(vertices, triangles)
    return volume.origin + volume.voxel * vertices, triangles


def _all_corners(known: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Return which cells have all eight corners known: one less along each axis."""
    for axis in range(3):
        low, high = (tuple(slice(a, a - 1 or None) if k == axis else slice(None) for k in range(3)) for a in (0, 1))
        known = known[low] & known[high]
    return known


def merge(vertices: Points, faces: NDArray[np.int64]) -> tuple[Points, NDArray[np.int64]]:
    """Return vertices and triangles with equal vertices made one, and without those that nothing
    uses."""
    keys = np.rint(vertices / _ALIKE).astype(np.int64)
    _, first, same = np.unique(keys, axis=0, return_index=True, return_inverse=True)
    faces = same.reshape(-1)[faces]
    whole = (faces[:, 0] != faces[:, 1]) & (faces[:, 1] != faces[:, 2]) & (faces[:, 0] != faces[:, 2])
    return _used(vertices[first], faces[whole])


def _used(vertices: Points, faces: NDArray[np.int64]) -> tuple[Points, NDArray[np.int64]]:
    used = np.unique(faces)
    place = np.zeros(len(vertices), np.int64)
    place[used] = np.arange(len(used))
    return vertices[used], place[faces]


def leave_out_small(vertices: Points, faces: NDArray[np.int64], smallest: float = SMALLEST) -> tuple[Points, NDArray[np.int64]]:
    """Return the mesh without connected parts of less than a share of all triangles."""
    if not len(faces):
        return vertices, faces
    links = coo_matrix((np.ones(2 * len(faces)), (faces[:, [0, 1]].ravel(), faces[:, [1, 2]].ravel())), (len(vertices),) * 2)
    part = connected_components(links, directed=False)[1][faces[:, 0]]
    return _used(vertices, faces[np.bincount(part)[part] >= smallest * len(faces)])


def colour(vertices: Points, views: Sequence[DepthView], voxel: float) -> NDArray[np.uint8]:
    """Return the colour [V, 3] of each vertex: the mean over the views that see it, weighted by the
    inverse square of the distance. Where none does: that of the nearest vertex that one sees, or
    grey."""
    total, weight = np.zeros((len(vertices), 3)), np.zeros(len(vertices))
    for view in views:
        camera = view.camera
        pose, K = camera.world_to_cam.double().numpy(), camera.K.double().numpy()
        local = vertices @ pose[:3, :3].T + pose[:3, 3]
        at, seen = sample(view, vertices)
        seen &= np.abs(at - local[:, 2]) <= _AGREES * voxel
        x, y, z = local[seen].T
        column = np.clip((K[0, 0] * x / z + K[0, 2]).astype(np.int64), 0, view.color.shape[1] - 1)
        row = np.clip((K[1, 1] * y / z + K[1, 2]).astype(np.int64), 0, view.color.shape[0] - 1)
        total[seen] += view.color[row, column] / (z * z)[:, None]
        weight[seen] += 1 / (z * z)
    mean, known = np.where(weight[:, None] > 0, total / np.maximum(weight, 1e-30)[:, None], 0.5), weight > 0
    if known.any() and not known.all():
        mean[~known] = mean[known][KDTree(vertices[known]).query(vertices[~known])[1]]
    return np.rint(255 * mean.clip(0, 1)).astype(np.uint8)
