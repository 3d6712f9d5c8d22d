"""Small scenes of anchors, and a camera that sees them."""

from dataclasses import replace

import torch

from scene_experts.core.types import Camera, Points
from scene_experts.scene.anchors.scene import Anchors, AnchorScene

EVERYTHING = lambda means, scales, camera: torch.ones(len(means), dtype=torch.bool)  # noqa: E731


def camera() -> Camera:
    pose = torch.eye(4)
    pose[:3, 3] = torch.tensor([0.1, -0.2, 6.0])
    return Camera(pose, torch.tensor([[80.0, 0, 40], [0, 80, 30], [0, 0, 1]]), 80, 60)


def scene(config: Anchors, n=200, seed=0) -> AnchorScene:
    torch.manual_seed(seed)
    xyz = torch.rand(n, 3, dtype=torch.float64) * 2 - 1
    made = AnchorScene.from_points(replace(config, voxel_size=0.01), Points(xyz, torch.zeros(n, 3, dtype=torch.uint8)), 5.0)
    for parameter, spread in (("feature", 1.0), ("offsets", 0.5)):
        made.table.params[parameter].data.normal_(0, spread)
    return made
