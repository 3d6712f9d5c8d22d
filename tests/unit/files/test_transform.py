"""Gaussians of another frame, harmonics included."""

from __future__ import annotations

import pytest
import torch

from scene_experts.data.transform import Similarity
from scene_experts.files.formats.splats import Splats
from scene_experts.files.transform import move, rotate_harmonics
from scene_experts.geometry import sh
from scene_experts.geometry.rotation import covariance, normalise_quats, quat_to_matrix


def random(*shape: int) -> torch.Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(len(shape) + sum(shape)), dtype=torch.float64)


def turn() -> torch.Tensor:
    return quat_to_matrix(normalise_quats(random(1, 4)))[0]


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_colours_turn_with_the_scene(degree: int) -> None:
    coefficients, rotation = random(5, (degree + 1) ** 2, 3), turn()
    directions = torch.nn.functional.normalize(random(40, 3), dim=1)
    turned = rotate_harmonics(coefficients, rotation)
    before = torch.einsum("dc,ncx->ndx", sh.basis(directions, degree), coefficients)
    after = torch.einsum("dc,ncx->ndx", sh.basis(directions @ rotation.T, degree), turned)
    torch.testing.assert_close(after, before, atol=1e-10, rtol=0)


def test_places_sizes_and_rotations() -> None:
    s = Splats(random(6, 3).float(), random(6, 3).float(), random(6, 4).float(), random(6).float(), random(6, 16, 3).float())
    by = Similarity(turn(), random(3), 2.5)
    found = move(s, by)
    torch.testing.assert_close(found.means, 2.5 * (by.rotation @ s.means.double().T).T + by.shift)
    want = 2.5**2 * by.rotation @ covariance(normalise_quats(s.quats.double()), s.log_scales.double().exp()) @ by.rotation.T
    torch.testing.assert_close(covariance(found.quats.double(), found.log_scales.double().exp()), want, rtol=1e-4, atol=1e-6)
    back = move(found, by.inverse)
    torch.testing.assert_close(back.means.float(), s.means, atol=1e-5, rtol=1e-5)
    torch.testing.assert_close(back.sh, s.sh, atol=1e-5, rtol=1e-5)
    p, second = random(3), Similarity(turn(), random(3), 0.3)
    both = by.then(second)
    expected = 0.3 * second.rotation @ (2.5 * by.rotation @ p + by.shift) + second.shift
    torch.testing.assert_close(both.scale * both.rotation @ p + both.shift, expected)
