"""Untrained scenes of every recipe, and a camera that sees them."""

import torch

from scene_experts.core.types import Camera, Points
from scene_experts.scene import Scene
from scene_experts.training.config import Train
from scene_experts.training.recipes import RECIPES

# one recipe of every scene family and of every kind of mixture
METHODS = (
    "scene-experts",
    "scaffold-gs",
    "moe-gs",
    "3dgs",
    "3dgs-mcmc",
    "octree-gs",
    "octree-moe-gs",
    "scaffold-gs-bank",
    "sags",
    "moe-gs-balance",
)

CAMERA = Camera(torch.eye(4), torch.tensor([[40.0, 0, 24], [0, 40, 16], [0, 0, 1]]), 48, 32, 0.2)


def start_scene(recipe: str | Train) -> Scene:
    """The untrained scene of a recipe, or of the recipe of a name, from 200 points."""
    torch.manual_seed(0)
    points = Points(torch.randn(200, 3, dtype=torch.float64) + torch.tensor([0.0, 0, 4]), torch.full((200, 3), 128, dtype=torch.uint8))
    cfg = RECIPES[recipe][1] if isinstance(recipe, str) else recipe
    return cfg.scene.start(points, 5.0, [CAMERA])
