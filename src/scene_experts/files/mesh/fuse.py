"""A surface from the depths of many views: a truncated signed distance on voxels near the surface.

Each view says of a voxel how far it lies before (positive) or behind (negative) what the view sees
there, in units of the truncation; the volume has the mean over the views (Curless and Levoy, "A
volumetric method for building complex models from range images", SIGGRAPH 1996). Voxels exist in
blocks of 8 x 8 x 8 around the points that the views see; elsewhere there is no surface.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from scene_experts.core.types import Camera

SIDE = 8  # voxels of a block's edge
TRUNCATION = 4.0  # voxels
EDGE = 0.05  # a pixel whose depth differs from a neighbour's by more than this share lies on an outline, and is left out
LEAST_ALPHA = 0.9  # opacity of a pixel with a surface
_MANY = 4096  # blocks that are treated together

Depths = NDArray[np.float32]
Points = NDArray[np.float64]


@dataclass(frozen=True)
class DepthView:
    """What one camera sees."""

    camera: Camera
    depth: Depths
    """[H, W] along z; 0 where there is no surface."""
    color: NDArray[np.float32]
    """[H, W, 3] RGB in [0, 1]."""


@dataclass(frozen=True)
class Volume:
    """Signed distances on blocks of voxels. The voxel (i, j, k) lies at origin + voxel (i, j, k)."""

    origin: Points
    """[3]"""
    voxel: float
    """Edge of a voxel."""
    blocks: NDArray[np.int64]
    """[B, 3] index of the first voxel of each block, over SIDE; sorted."""
    distance: NDArray[np.float32]
    """[B, 8, 8, 8] mean signed distance over the truncation, in [-1, 1]."""
    weight: NDArray[np.float32]
    """[B, 8, 8, 8] views that say so."""


def clean(depth: Depths, alpha: Depths) -> Depths:
    """Return mean depths [H, W] from depths times opacity, 0 where the opacity [H, W] is below
    LEAST_ALPHA and on outlines, where a mean lies between two surfaces."""
    out = np.where(alpha >= LEAST_ALPHA, depth / np.maximum(alpha, 1e-6), 0).astype(np.float32)
    near, far = out.copy(), out.copy()
    for axis in (0, 1):
        for step in (1, -1):
            moved = np.roll(out, step, axis)
            edge = (slice(None),) * axis + (0 if step == 1 else -1,)
            moved[edge] = out[edge]
            near, far = np.minimum(near, moved), np.maximum(far, moved)
    return np.where((out > 0) & (far - near <= EDGE * out), out, 0).astype(np.float32)


def see_points(view: DepthView, every: int = 1) -> Points:
    """Return the points [N, 3] of the world that a view sees, of every `every`th pixel."""
    camera = view.camera
    v, u = np.nonzero(view.depth)
    keep = (v % every == 0) & (u % every == 0)
    v, u = v[keep], u[keep]
    z = view.depth[v, u].astype(np.float64)
    K, pose = camera.K.double().numpy(), camera.world_to_cam.double().numpy()
    local = np.stack([(u + 0.5 - K[0, 2]) / K[0, 0] * z, (v + 0.5 - K[1, 2]) / K[1, 1] * z, z], 1)
    return (local - pose[:3, 3]) @ pose[:3, :3]


def find_blocks(points: Points, origin: Points, voxel: float) -> NDArray[np.int64]:
    """Return the blocks [B, 3] within the truncation of the points, sorted."""
    reach = TRUNCATION * voxel
    corners = np.stack(np.meshgrid(*[(-reach, reach)] * 3, indexing="ij"), -1).reshape(-1, 3)
    found = [np.floor((points + corner - origin) / (SIDE * voxel)).astype(np.int64) for corner in corners]
    return np.unique(np.concatenate([np.unique(one, axis=0) for one in found]), axis=0)


def fuse(
    views: Sequence[DepthView],
    blocks: NDArray[np.int64],
    origin: Points,
    voxel: float,
    tell: Callable[[int, int], None] = lambda done, total: None,
) -> Volume:
    """Return the mean signed distances of the views on blocks of voxels. tell: called with the
    blocks that are done, and all."""
    inside = np.stack(np.meshgrid(*[np.arange(SIDE)] * 3, indexing="ij"), -1).reshape(1, -1, 3)
    total = np.zeros((len(blocks), SIDE**3), np.float32)
    weight = np.zeros_like(total)
    for first in range(0, len(blocks), _MANY):
        corner = origin + voxel * SIDE * blocks[first : first + _MANY]
        for view in views:
            chosen = _may_see(view.camera, corner + voxel * SIDE / 2, voxel * SIDE)
            part = first + chosen
            places = (corner[chosen][:, None] + voxel * inside).reshape(-1, 3)
            at, seen = sample(view, places)
            away = (at - _z(view.camera, places)) / (TRUNCATION * voxel)
            counts = (seen & (away >= -1)).reshape(-1, SIDE**3)
            total[part] += np.where(counts, np.minimum(away, 1).reshape(-1, SIDE**3), 0)
            weight[part] += counts
        tell(min(first + _MANY, len(blocks)), len(blocks))
    shape = (-1, SIDE, SIDE, SIDE)
    mean = (total / np.maximum(weight, 1)).astype(np.float32)
    return Volume(origin, voxel, blocks, mean.reshape(shape), weight.reshape(shape))


def _may_see(camera: Camera, centres: Points, radius: float) -> NDArray[np.int64]:
    """Return which spheres [n] a camera may see."""
    pose, K = camera.world_to_cam.double().numpy(), camera.K.double().numpy()
    x, y, z = (centres @ pose[:3, :3].T + pose[:3, 3]).T
    z = np.maximum(z, 0)  # one beside the camera may reach into the picture
    left, right = -K[0, 2] / K[0, 0], (camera.width - K[0, 2]) / K[0, 0]
    top, bottom = -K[1, 2] / K[1, 1], (camera.height - K[1, 2]) / K[1, 1]
    reach = radius * (1 + max(abs(left), abs(right), abs(top), abs(bottom)))
    inside = (x > left * z - reach) & (x < right * z + reach) & (y > top * z - reach) & (y < bottom * z + reach)
    return np.flatnonzero(inside & (centres @ pose[2, :3] + pose[2, 3] > -radius))


def _z(camera: Camera, places: Points) -> Points:
    pose = camera.world_to_cam.double().numpy()
    return places @ pose[2, :3] + pose[2, 3]


def sample(view: DepthView, places: Points) -> tuple[Depths, NDArray[np.bool_]]:
    """Return the depth [N] that a view has in the direction of places [N, 3] of the world, between
    its pixels, and where the four pixels around all have one [N]."""
    camera = view.camera
    pose, K = camera.world_to_cam.double().numpy(), camera.K.double().numpy()
    local = places @ pose[:3, :3].T + pose[:3, 3]
    z = local[:, 2]
    before = z > camera.near
    z = np.where(before, z, 1)
    u, v = K[0, 0] * local[:, 0] / z + K[0, 2] - 0.5, K[1, 1] * local[:, 1] / z + K[1, 2] - 0.5
    H, W = view.depth.shape
    seen = before & (u >= 0) & (v >= 0) & (u <= W - 1) & (v <= H - 1)
    u, v = np.where(seen, u, 0), np.where(seen, v, 0)
    i, j = np.minimum(v.astype(np.int64), H - 2), np.minimum(u.astype(np.int64), W - 2)
    a, b = (v - i).astype(np.float32), (u - j).astype(np.float32)
    four = [view.depth[i + di, j + dj] for di in (0, 1) for dj in (0, 1)]
    seen &= np.minimum.reduce(four) > 0
    found = (1 - a) * ((1 - b) * four[0] + b * four[1]) + a * ((1 - b) * four[2] + b * four[3])
    return found.astype(np.float32), seen
