"""Explicit Gaussians with gradients, an optimiser's state and growth statistics."""

import math

import torch

from scene_experts.core.table import Table
from scene_experts.scene.gaussians import Explicit, GaussianScene
from scene_experts.training.optim import FusedAdam

EXTENT = 5.0


def make_gaussians(n=200, seed=0) -> GaussianScene:
    """n random Gaussians after one optimiser step; some have gradients above the threshold of 2e-4."""
    torch.manual_seed(seed)
    params = {
        "means": torch.randn(n, 3),
        "log_scales": torch.randn(n, 3) * 0.5 + math.log(0.04),  # about the clone size of 0.05
        "quats": torch.randn(n, 4),
        "raw_opacity": torch.randn(n) - 4,
        "sh_dc": torch.randn(n, 3),
        "sh_rest": torch.randn(n, 15, 3),
    }
    scene = GaussianScene(Explicit(), Table(params, {}), EXTENT)
    groups = scene.rate_groups().items()
    optimizer = FusedAdam([{"params": p, "name": name, "lr": 0.0, "by_row": True} for name, p in groups])
    scene.table.attach(optimizer)
    for parameter in scene.table.params.values():
        parameter.grad = torch.randn_like(parameter)
    optimizer.step()
    scene.table.stats = {"count": torch.randint(0, 4, (n,)).float()}
    scene.table.stats["grad"] = scene.table.stats["count"] * torch.rand(n) * 4e-4
    return scene


def moments(scene: GaussianScene, name: str) -> torch.Tensor:
    """Adam's first moments of one parameter."""
    assert scene.table._optimizer is not None
    return scene.table._optimizer.state[scene.table.params[name]]["exp_avg"]
