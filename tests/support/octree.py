"""The level that Octree-GS computes from a distance, for one anchor."""

import math

import torch

from scene_experts.core.types import Camera


def camera_at(x: float, y: float, z: float) -> Camera:
    """A camera at (x, y, z) that looks along +z."""
    pose = torch.eye(4)
    pose[:3, 3] = -torch.tensor([x, y, z])
    return Camera(pose, torch.eye(3), 4, 4)


def slow_level(x: list[float], level: int, position: tuple[float, ...]) -> float:
    """The level wanted at `position` for the anchor at lattice corner x, in a lattice of cell 0.8, factor 2 and standard distance 8."""
    r = math.dist([c + 0.8 / (2 * 2**level) for c in x], position)
    return math.log2(8.0 / r)
