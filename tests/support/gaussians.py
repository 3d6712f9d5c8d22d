"""A rotated camera and random Gaussians in front of it, in float64."""

from __future__ import annotations

import math

import torch

from scene_experts.core.types import Camera, Gaussians
from scene_experts.geometry.rotation import normalise_quats

F64 = torch.float64


def make_camera(
    width: int = 45, height: int = 37, cx: float | None = None, cy: float | None = None, f: float = 40.0, near: float = 0.2
) -> Camera:
    """A camera turned by 0.2 rad about y that looks at the origin from a distance of about 3."""
    angle = 0.2
    world_to_cam = torch.eye(4, dtype=F64)
    world_to_cam[0, 0] = world_to_cam[2, 2] = math.cos(angle)
    world_to_cam[0, 2], world_to_cam[2, 0] = math.sin(angle), -math.sin(angle)
    world_to_cam[:3, 3] = torch.tensor([0.1, -0.05, 3.0])
    K = torch.tensor([[f, 0, width / 2 if cx is None else cx], [0, 1.1 * f, height / 2 if cy is None else cy], [0, 0, 1]], dtype=F64)
    return Camera(world_to_cam, K, width, height, near)


def make_scene(n: int = 40, seed: int = 0, size: float = 0.15, spread: float = 0.8) -> Gaussians:
    """n random Gaussians around the origin."""
    g = torch.Generator().manual_seed(seed)
    scales = size * (0.5 * torch.randn(n, 3, generator=g, dtype=F64)).exp()
    return Gaussians(
        means=spread * torch.randn(n, 3, generator=g, dtype=F64),
        quats=normalise_quats(torch.randn(n, 4, generator=g, dtype=F64)),
        scales=scales,
        opacities=0.02 + 0.97 * torch.rand(n, generator=g, dtype=F64),
        colors=torch.rand(n, 3, generator=g, dtype=F64),
        source=torch.arange(n),
    )
