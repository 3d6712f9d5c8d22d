"""Views of a sphere of radius 1 around the origin."""

from collections.abc import Sequence

import numpy as np
import torch

from scene_experts.core.types import Camera
from scene_experts.files.mesh.fuse import DepthView, clean

WIDTH, HEIGHT, FOCAL = 80, 60, 75.0


def sphere_view(eye: Sequence[float], color: float = 0.25, index: int = 0) -> DepthView:
    """What a camera at `eye` that looks at the origin sees, exactly."""
    o = np.asarray(eye, float)
    forward = -o / np.linalg.norm(o)
    right = np.cross(forward, [0, 0, 1.0])
    right /= np.linalg.norm(right)
    turn = np.stack([right, np.cross(forward, right), forward])
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = turn, -turn @ o
    K = np.array([[FOCAL, 0, WIDTH / 2], [0, FOCAL, HEIGHT / 2], [0, 0, 1]])
    v, u = np.mgrid[0:HEIGHT, 0:WIDTH] + 0.5
    ray = np.stack([(u - K[0, 2]) / FOCAL, (v - K[1, 2]) / FOCAL, np.ones_like(u)], -1) @ turn
    a, b, c = (ray * ray).sum(-1), ray @ o, o @ o - 1
    root = b * b - a * c
    alpha = (root > 0).astype(np.float32)
    z = np.where(root > 0, (-b - np.sqrt(np.maximum(root, 0))) / a, 0).astype(np.float32)
    camera = Camera(torch.tensor(pose, dtype=torch.float32), torch.tensor(K, dtype=torch.float32), WIDTH, HEIGHT, id=index)
    return DepthView(camera, clean(z * alpha, alpha), np.full((HEIGHT, WIDTH, 3), color, np.float32))


def around(count: int) -> list[DepthView]:
    """Views from all around, at several heights."""
    turn = 2 * np.pi * np.arange(count) / count
    up = 0.9 * np.sin(3 * turn)
    return [
        sphere_view((3 * np.cos(t) * np.cos(h), 3 * np.sin(t) * np.cos(h), 3 * np.sin(h)), index=i)
        for i, (t, h) in enumerate(zip(turn, up))
    ]
