"""The benchmark scene of the rasterisers: a point cloud turned into any number of Gaussians of
realistic sizes.

The cloud comes from structure from motion in an .npz (means3d [P, 3], colors [P, 3] uint8,
viewmats, Ks, width, height). Without a file, a similar one is synthesised: a table with objects,
ground, hedges and a far background, seen from a camera beside the table.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from scene_experts.core.types import Camera, Gaussians
from scene_experts.geometry.neighbours import knn_d2

POINTS = 138_766  # number of points of the synthetic cloud, as in the garden capture


@dataclass(frozen=True)
class Cloud:
    """Points and a camera."""

    xyz: np.ndarray  # [P, 3] float64
    rgb: np.ndarray  # [P, 3] in [0, 1]
    view: np.ndarray  # [4, 4] world to camera
    K: np.ndarray  # [3, 3] px
    width: int
    height: int


def read_cloud(path: Path) -> Cloud:
    """Read the cloud and the first camera of an .npz file."""
    with np.load(path, allow_pickle=False) as data:
        return Cloud(
            data["means3d"].astype(np.float64),
            data["colors"] / 255.0,
            data["viewmats"][0],
            data["Ks"][0],
            int(data["width"]),
            int(data["height"]),
        )


def make_cloud(seed: int = 0) -> Cloud:
    """Synthesise a garden-like cloud of POINTS points."""
    rng = np.random.default_rng(seed)
    shares = np.array([0.3, 0.1, 0.25, 0.2, 0.15])
    table, things, ground, hedge, far = (int(n) for n in np.floor(shares * POINTS))
    far += POINTS - table - things - ground - hedge - far
    angle = lambda n: rng.uniform(0, 2 * np.pi, n)  # noqa: E731
    ring = lambda n, r: np.stack([r * np.cos(a := angle(n)), r * np.sin(a)], 1)  # noqa: E731
    parts = [
        np.c_[ring(table, 0.8 * np.sqrt(rng.random(table))), rng.normal(0, 0.004, table)],
        np.c_[ring(things, 0.15 + 0.05 * rng.random(things)), 0.4 * rng.random(things)],
        np.c_[ring(ground, 0.5 + 4 * rng.random(ground)), -0.7 + rng.normal(0, 0.01, ground)],
        np.c_[ring(hedge, 4 + rng.normal(0, 0.25, hedge)), -0.7 + 2 * rng.random(hedge) ** 1.5],
        np.c_[ring(far, 8 + 20 * rng.random(far)), -0.7 + 8 * rng.random(far)],
    ]
    xyz = np.concatenate(parts)
    K = np.array([[480.6, 0, 324.2], [0, 481.5, 210.1], [0, 0, 1]])
    return Cloud(xyz, rng.random((POINTS, 3)), _look_at(np.array([1.6, 0.3, 0.9])), K, 648, 420)


def _look_at(eye: np.ndarray) -> np.ndarray:
    """World to camera (x right, y down, z forward) from `eye` towards the origin, with the z axis
    of the world up."""
    forward = -eye / np.linalg.norm(eye)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    view = np.eye(4)
    view[:3, :3] = np.stack([right, np.cross(forward, right), forward])
    view[:3, 3] = -view[:3, :3] @ eye
    return view


def make_scene(cloud: Cloud, count: int, width: int, height: int, seed: int = 0) -> tuple[Gaussians, Camera]:
    """Sample `count` Gaussians from the cloud (with jitter beyond its size) and scale its camera to
    `width` x `height` pixels.

    Scales are the RMS distance to 3 neighbours times exp(N(0, 0.5)) times (1, 1, 0.35); opacities
    0.004 + 0.995 Beta(0.7, 0.9).
    """
    rng = np.random.default_rng(seed)
    total = len(cloud.xyz)
    rows = rng.permutation(total)[:count] if count <= total else np.concatenate([np.arange(total), rng.integers(0, total, count - total)])
    xyz = cloud.xyz[rows]
    base = np.sqrt(knn_d2(torch.from_numpy(np.ascontiguousarray(xyz))).numpy()) if count <= total else None
    if base is None:
        known = np.sqrt(knn_d2(torch.from_numpy(cloud.xyz)).numpy())[rows]
        xyz = xyz + rng.normal(size=xyz.shape) * (0.5 * known[:, None]) * (np.arange(count) >= total)[:, None]
        base = np.sqrt(knn_d2(torch.from_numpy(xyz)).numpy())
    scales = base[:, None] * np.exp(rng.normal(0, 0.5, (count, 3))) * np.array([1, 1, 0.35])
    quats = rng.normal(size=(count, 4))
    quats /= np.linalg.norm(quats, axis=1, keepdims=True)
    opacities = 0.004 + 0.995 * rng.beta(0.7, 0.9, count)
    single = lambda a: torch.from_numpy(np.ascontiguousarray(a, dtype=np.float32))  # noqa: E731
    columns = [single(a) for a in (xyz, quats, np.maximum(scales, 1e-7), opacities, cloud.rgb[rows])]
    gaussians = Gaussians(columns[0], columns[1], columns[2], columns[3], columns[4], torch.arange(count))
    K = cloud.K * np.array([width / cloud.width, height / cloud.height, 1])[:, None]
    return gaussians, Camera(single(cloud.view), single(K), width, height, near=0.01)
