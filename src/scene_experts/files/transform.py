"""Brings Gaussians of another frame into that of a capture."""

from __future__ import annotations

import math
from dataclasses import replace

import torch
from torch import Tensor

from scene_experts.data.transform import Similarity
from scene_experts.files.formats.splats import Splats
from scene_experts.geometry import sh
from scene_experts.geometry.rotation import matrix_to_quat, normalise_quats, quat_to_matrix


def move(splats: Splats, by: Similarity) -> Splats:
    """Return the Gaussians at their new places; their positions are float64."""
    turned = by.rotation @ quat_to_matrix(normalise_quats(splats.quats.double()))
    return replace(
        splats,
        means=by.scale * splats.means.double() @ by.rotation.T + by.shift,
        log_scales=splats.log_scales + math.log(by.scale),
        quats=matrix_to_quat(turned).float(),
        sh=rotate_harmonics(splats.sh, by.rotation),
    )


def rotate_harmonics(coefficients: Tensor, rotation: Tensor) -> Tensor:
    """Return coefficients [N, C, 3] whose colours along rotated directions are those of the given
    ones along the directions themselves. rotation: [3, 3] float64."""
    degree = math.isqrt(coefficients.shape[1]) - 1
    directions = torch.nn.functional.normalize(torch.randn(128, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64), dim=1)
    before, after = sh.basis(directions, degree), sh.basis(directions @ rotation.T, degree)
    mix = torch.linalg.lstsq(after, before).solution  # after @ mix = before; each degree mixes within itself
    return torch.einsum("ij,njc->nic", mix, coefficients.double()).to(coefficients.dtype)
