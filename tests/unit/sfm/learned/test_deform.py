"""Deformable convolutions against their equation."""

import math

import numpy as np
import torch
from torch.nn import functional

from scene_experts.sfm.learned.deform import deformable_conv, sample


def bilinear(grid: np.ndarray, x: float, y: float) -> float:
    """The value of grid [H, W] between its pixels; 0 outside."""
    total = 0.0
    for row in (math.floor(y), math.floor(y) + 1):
        for column in (math.floor(x), math.floor(x) + 1):
            if 0 <= row < grid.shape[0] and 0 <= column < grid.shape[1]:
                total += grid[row, column] * (1 - abs(y - row)) * (1 - abs(x - column))
    return total


def reference(x: np.ndarray, offsets: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """y_c(p) = sum_k sum_d weight_cdk x_d(p + p_k + offset_k(p)), one number after the other."""
    out = np.zeros((len(weight), *x.shape[1:]))
    for row in range(x.shape[1]):
        for column in range(x.shape[2]):
            for k in range(9):
                py, px = row + k // 3 - 1 + offsets[2 * k, row, column], column + k % 3 - 1 + offsets[2 * k + 1, row, column]
                for d in range(len(x)):
                    out[:, row, column] += weight[:, d, k // 3, k % 3] * bilinear(x[d], px, py)
    return out


def test_it_is_the_sum_of_the_equation():
    gen = torch.Generator().manual_seed(1)
    x, weight = torch.randn(3, 5, 7, generator=gen, dtype=torch.float64), torch.randn(4, 3, 3, 3, generator=gen, dtype=torch.float64)
    offsets = 2 * torch.randn(18, 5, 7, generator=gen, dtype=torch.float64)  # some lead out of the picture
    found = deformable_conv(x, offsets, weight).numpy()
    assert np.allclose(found, reference(x.numpy(), offsets.numpy(), weight.numpy()), atol=1e-10)


def test_without_offsets_it_is_a_convolution():
    gen = torch.Generator().manual_seed(2)
    x, weight = torch.randn(3, 6, 4, generator=gen), torch.randn(2, 3, 3, 3, generator=gen)
    assert torch.allclose(deformable_conv(x, torch.zeros(18, 6, 4), weight), functional.conv2d(x[None], weight, padding=1)[0], atol=1e-5)


def test_values_between_pixels():
    grid = torch.arange(12.0).reshape(1, 3, 4)
    places = torch.tensor([[1.0, 2.0], [0.5, 0.25], [-0.5, 0.0], [3.0, 2.5], [9.0, 9.0]])
    assert torch.allclose(sample(grid, places)[0], torch.tensor([9.0, 1.5, 0.0, 5.5, 0.0]), atol=1e-5)
    assert sample(grid, torch.zeros(0, 2)).shape == (1, 0)
