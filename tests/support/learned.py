"""Random weights of ALIKED and LightGlue, of the right shapes."""

from __future__ import annotations

from pathlib import Path

import torch
from torch import Tensor

from scene_experts.sfm.learned import aliked, lightglue
from scene_experts.sfm.learned.weights import FILES


def random_tensors(shapes: dict[str, tuple[int, ...]], seed: int = 0) -> dict[str, Tensor]:
    """Weights that keep the activations near 1."""
    gen = torch.Generator().manual_seed(seed)
    out = {}
    for name, shape in shapes.items():
        if name.endswith("num_batches_tracked"):
            out[name] = torch.tensor(7)
        elif name.endswith("running_var"):
            out[name] = 0.5 + torch.rand(shape, generator=gen)
        else:
            value = torch.randn(shape, generator=gen)
            out[name] = value * value[0].numel() ** -0.5 if value.dim() > 1 else 0.1 * value
    return out


def write_weights(folder: Path) -> Path:
    """Write the weights of both networks as their package carries them."""
    folder.mkdir(parents=True, exist_ok=True)
    for name, shapes in zip(FILES, (aliked.tensor_shapes(), lightglue.tensor_shapes()), strict=True):
        torch.save(random_tensors(shapes), folder / name)
    return folder
