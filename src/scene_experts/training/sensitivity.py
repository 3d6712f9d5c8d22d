"""How much the pictures of a scene depend on each of its values.

The sensitivity of a value is the mean over pixels and channels of the squared derivative of the
picture. One backward pass for each view estimates it for all values: with a random sign for each
pixel and channel, the square of the gradient has that sum as its mean. Only cameras are needed, no
photographs.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

import torch
from torch import Tensor

from scene_experts.core.types import Camera, Mode
from scene_experts.render import Rasterizer
from scene_experts.scene import Scene

MOST_VIEWS = 48  # evenly chosen


def evenly(items: Sequence[int], most: int) -> list[int]:
    """At most `most` items, evenly chosen."""
    every = max(1, -(-len(items) // most))
    return list(items[::every])


def find_sensitivity(
    scene: Scene,
    values: Mapping[str, Tensor],
    step: int,
    cameras: Sequence[Camera],
    background: Tensor,
    rasterize: Rasterizer,
    tell: Callable[[int, int], None] = lambda done, total: None,
) -> dict[str, Tensor]:
    """Return the sensitivity of parameters of a scene, of their shapes, from its pictures at
    `cameras` over `background` [3].

    tell: called with the number of cameras that are done, and of all.
    """
    before = [value.requires_grad for value in values.values()]
    totals = {name: torch.zeros_like(value) for name, value in values.items()}
    generator, pixels = torch.Generator().manual_seed(0), 0
    try:
        for value in values.values():
            value.requires_grad_(True)
        for i, camera in enumerate(cameras):
            decoded = scene(camera, step, Mode.DRAW, rasterize.visible)
            image = rasterize(decoded.gaussians, camera, background).image
            signs = (torch.randint(0, 2, image.shape, generator=generator) * 2 - 1).to(image)
            if image.requires_grad:
                found = torch.autograd.grad((image * signs).sum(), list(values.values()), allow_unused=True)
                for total, gradient in zip(totals.values(), found):
                    if gradient is not None:
                        total += gradient.square()
            pixels += image.numel()
            tell(i + 1, len(cameras))
    finally:
        for value, wanted in zip(values.values(), before):
            value.requires_grad_(wanted)
    return {name: (total / max(pixels, 1)).nan_to_num(0, 0, 0) for name, total in totals.items()}
