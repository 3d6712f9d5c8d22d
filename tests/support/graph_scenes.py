"""Graph scenes with values like those of a trained one, and a camera that sees them."""

import torch

from scene_experts.core.types import Camera, Points
from scene_experts.scene.graph.scene import GraphPoints, GraphScene

CAMERA = Camera(torch.eye(4), torch.tensor([[40.0, 0, 24], [0, 40, 16], [0, 0, 1]]), 48, 32, 0.2)


def cloud(n: int = 80) -> Points:
    xyz = torch.randn(n, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(4)) * torch.tensor([2.0, 1.5, 0.5])
    return Points(xyz + torch.tensor([0.0, 0, 5]), torch.full((n, 3), 128, dtype=torch.uint8))


def start_graph(dtype: torch.dtype = torch.float64, **changes) -> GraphScene:
    """A scene whose features and offsets have left their initial values."""
    torch.manual_seed(0)
    scene = GraphPoints(**{"voxel_size": 0.05, **changes}).start(cloud(), 5.0, [CAMERA])
    for p in (scene.table.params["feature"], scene.beta, scene.grid.table):
        p.data.normal_(0, 0.1 if p is scene.beta else 1.5)
    scene.heads["opacity"].layers[0].data[:, scene.grid.config.width + scene.config.F :] /= 20  # otherwise every point or none is visible
    scene = scene.to(dtype)
    scene.table.facts["xyz"] = scene.table.facts["xyz"].to(dtype)
    return scene


def everyone(means: torch.Tensor, scales: torch.Tensor, camera: Camera) -> torch.Tensor:
    return torch.ones(len(means), dtype=torch.bool)
