"""Curvature of known surfaces, and midpoint pairs against slow loops."""

import math

import pytest
import torch

from scene_experts.geometry.curvature import curvature, find_flat, find_midpoint_pairs


def random(n: int, d: int = 3) -> torch.Tensor:
    return torch.rand(n, d, dtype=torch.float64, generator=torch.Generator().manual_seed(0))


def test_a_plane_and_a_line_are_flat_and_a_ball_is_not():
    plane = torch.cat([random(300, 2), torch.zeros(300, 1, dtype=torch.float64)], dim=1)
    turn = torch.linalg.qr(torch.randn(3, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(1))).Q
    assert float(curvature(plane @ turn.T + 7).max()) < 1e-12
    assert float(curvature(random(50, 1) * torch.ones(1, 3, dtype=torch.float64)).max()) < 1e-12
    assert float(curvature(random(2000)).mean()) > 0.15


def test_singular_values_and_not_eigenvalues():
    """A neighbourhood shaped like an octahedron with half-axes 3, 2, 1 has singular values in this ratio."""
    axes = torch.tensor([[3.0, 0, 0], [0, 2, 0], [0, 0, 1]], dtype=torch.float64)
    points = torch.cat([torch.zeros(1, 3, dtype=torch.float64), axes, -axes])
    assert curvature(points, 7).tolist() == pytest.approx([1 / 6] * 7)


def test_a_sphere_curves_more_the_smaller_it_is():
    i = torch.arange(4000, dtype=torch.float64)
    z, phi = 1 - (2 * i + 1) / 4000, i * math.pi * (3 - math.sqrt(5))
    sphere = torch.stack([(1 - z * z).sqrt() * phi.cos(), (1 - z * z).sqrt() * phi.sin(), z], dim=1)
    few = sphere[::8]
    assert float(curvature(few).mean()) > 1.5 * float(curvature(sphere).mean()) > 0


@pytest.mark.parametrize("n", [0, 1, 2, 3, 9])
def test_few_points_and_points_in_one_place(n):
    found = curvature(random(n))
    assert found.shape == (n,) and bool(torch.isfinite(found).all())
    assert not bool(find_flat(curvature(torch.ones(n, 3))).any())
    assert len(find_midpoint_pairs(random(n), torch.ones(n, dtype=torch.bool), 10, 5)) == n * (n + 1) // 2


def test_flatter_is_a_z_score():
    values = torch.tensor([0.0, 0.1, 0.1, 0.1, 0.1, 0.2], dtype=torch.float64)
    assert find_flat(values).tolist() == [True] + [False] * 5
    assert find_flat(values * 3 + 5).tolist() == [True] + [False] * 5
    assert not bool(find_flat(values, 3.0).any())


@pytest.mark.parametrize(("low", "high"), [(10, 5), (10, 2), (4, 8), (1, 0)])
def test_pairs_are_those_of_the_slow_rule(low, high):
    points = random(60)
    flat = torch.rand(60, generator=torch.Generator().manual_seed(3)) < 0.4
    order = torch.cdist(points, points).argsort(dim=1)  # itself first: no two points are equal
    wanted = {(i, i) for i in range(60)}
    for i in range(60):
        near = order[i, :low] if flat[i] else order[i, 1 : high + 1]
        wanted |= {(min(i, int(j)), max(i, int(j))) for j in near}
    found = find_midpoint_pairs(points, flat, low, high)
    assert len(found) == len(wanted) and {(int(a), int(b)) for a, b in found} == wanted
