"""The deformable convolution (Dai et al., "Deformable convolutional networks", ICCV 2017)."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn import functional

SIDE = 3  # px of the kernel


def sample(grid: Tensor, places: Tensor) -> Tensor:
    """Return the values of `grid` [C, H, W] at `places` [..., 2] (x, y in pixels, 0 at the centre of
    the first one), bilinearly [C, ...]; a pixel outside the grid counts as 0."""
    height, width = grid.shape[1:]
    last = places.new_tensor([max(width - 1, 1), max(height - 1, 1)])
    unit = (2 * places / last - 1).reshape(1, 1, -1, 2)
    found = functional.grid_sample(grid[None], unit, mode="bilinear", padding_mode="zeros", align_corners=True)
    return found.reshape(grid.shape[0], *places.shape[:-1])


def deformable_conv(x: Tensor, offsets: Tensor, weight: Tensor) -> Tensor:
    """Return the convolution [C, H, W] of `x` [D, H, W] with `weight` [C, D, 3, 3], whose tap k of
    pixel p reads x at p + p_k + offset_k(p) instead of p + p_k:

        y_c(p) = sum_k sum_d weight_cdk x_d(p + p_k + offset_k(p))

    p_k are the nine places from (-1, -1) to (1, 1), row by row. offsets: [18, H, W], for each tap
    its dy and its dx in pixels.
    """
    height, width = x.shape[1:]
    rows, columns = torch.meshgrid(torch.arange(height), torch.arange(width), indexing="ij")
    here = torch.stack([columns, rows], dim=-1).to(x)
    taps = []
    for k in range(SIDE * SIDE):
        shift = torch.stack([offsets[2 * k + 1] + (k % SIDE - 1), offsets[2 * k] + (k // SIDE - 1)], dim=-1)
        taps.append(sample(x, here + shift).reshape(len(x), -1))
    read = torch.stack(taps, dim=1).reshape(-1, height * width)  # [D * 9, H * W], in the order of the weights
    return (weight.reshape(len(weight), -1) @ read).reshape(-1, height, width)
