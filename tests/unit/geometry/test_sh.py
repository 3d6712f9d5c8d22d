from __future__ import annotations

import math

import pytest
import torch

from scene_experts.geometry import sh
from support.messages import naming


def sphere(n: int) -> torch.Tensor:
    """Evenly distributed directions (a Fibonacci lattice): a mean over them is an integral over the sphere."""
    i = torch.arange(n, dtype=torch.float64) + 0.5
    z, phi = 1 - 2 * i / n, math.pi * (1 + 5**0.5) * i
    r = (1 - z * z).sqrt()
    return torch.stack([r * phi.cos(), r * phi.sin(), z], dim=1)


def test_basis_is_orthonormal() -> None:
    values = sh.basis(sphere(20_000), 3)
    gram = values.T @ values * (4 * math.pi / 20_000)
    torch.testing.assert_close(gram, torch.eye(16, dtype=torch.float64), atol=1e-3, rtol=0)


def test_order_and_signs_of_the_first_bands() -> None:
    x, y, z = torch.eye(3, dtype=torch.float64)
    c1 = math.sqrt(3 / (4 * math.pi))
    for direction, expected in ((x, [0, 0, -c1]), (y, [-c1, 0, 0]), (z, [0, c1, 0])):
        torch.testing.assert_close(sh.basis(direction, 1)[1:], torch.tensor(expected, dtype=torch.float64))
    second = sh.basis(z, 2)[4:]
    torch.testing.assert_close(second, torch.tensor([0, 0, 2 * sh.C2[2], 0, 0], dtype=torch.float64))
    diagonal = (x + y) / 2**0.5
    assert sh.basis(diagonal, 2)[4] == pytest.approx(0.5 * math.sqrt(15 / math.pi) * 0.5)


def test_a_constant_colour_survives() -> None:
    rgb = torch.rand(10, 3, generator=torch.Generator().manual_seed(0))
    coefficients = torch.zeros(10, 16, 3)
    coefficients[:, 0] = sh.rgb_to_dc(rgb)
    directions = torch.randn(10, 3, generator=torch.Generator().manual_seed(1))
    for degree in range(4):
        torch.testing.assert_close(sh.sh_to_rgb(coefficients, directions, degree), rgb)


def test_length_of_the_direction_does_not_matter_and_gradients_are_right() -> None:
    generator = torch.Generator().manual_seed(0)
    coefficients = (torch.randn(4, 16, 3, generator=generator, dtype=torch.float64) * 0.1).requires_grad_()
    directions = torch.randn(4, 3, generator=generator, dtype=torch.float64).requires_grad_()
    torch.testing.assert_close(sh.sh_to_rgb(coefficients, directions, 3), sh.sh_to_rgb(coefficients, 5 * directions, 3))
    assert torch.autograd.gradcheck(lambda c, d: sh.sh_to_rgb(c, d, 3), (coefficients, directions))


def test_a_clamped_colour_has_no_gradient() -> None:
    coefficients = torch.tensor([[[-3.0, 1.0, 0.0]]], requires_grad=True)
    rgb = sh.sh_to_rgb(coefficients, torch.ones(1, 3), 0)
    rgb.sum().backward()
    assert rgb[0, 0] == 0
    assert coefficients.grad is not None
    torch.testing.assert_close(coefficients.grad[0, 0], torch.tensor([0.0, sh.C0, sh.C0]))


def test_too_few_coefficients_are_refused() -> None:
    with pytest.raises(ValueError, match="16"):
        sh.sh_to_rgb(torch.zeros(1, 9, 3), torch.ones(1, 3), 3)
    with pytest.raises(ValueError, match=naming(0, 3)):
        sh.basis(torch.ones(1, 3), 4)
