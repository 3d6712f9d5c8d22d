"""Draws one view with the compiled functions of gsplat, and goes backward through them, without
autograd. The pictures are those of `gsplat.GsplatRasterizer` without the depth.

The functions are gsplat's own and no public interface, so one version is known. With any other,
training takes the way through autograd.
"""

from __future__ import annotations

import importlib
from functools import cache
from typing import Any

import torch
from torch import Tensor

from scene_experts.core.gradients import BackwardPicture, GaussianGradients
from scene_experts.core.types import Camera, Gaussians, Render
from scene_experts.render.project_cuda import find_radii
from scene_experts.render.reference import BLUR, MIN_COMPENSATION, TILE

KNOWN = "1.5.3"  # version of gsplat
FAR = 1e10  # far plane, world units


@cache
def explain_unknown() -> str | None:
    """Return None if the installed gsplat is known, else the reason why it cannot be used here."""
    found = importlib.import_module("gsplat").__version__
    return None if found == KNOWN else f"gsplat {found}: {KNOWN} is known"


@cache
def _library() -> Any:
    return importlib.import_module("gsplat.cuda._backend")._C


@cache
def _half_sides(width: int, height: int, device: torch.device) -> Tensor:
    return torch.tensor([width / 2, height / 2], device=device)


@cache
def _zero(device: torch.device) -> Tensor:
    return torch.zeros((), device=device)


def _nothing(count: int, device: torch.device) -> Tensor:
    """Return zeros [count], of an array that grows. Nothing may write to them."""
    known = _zeros.get(device)
    if known is None or known.shape[0] < count:
        known = _zeros[device] = torch.zeros(count + count // 4, device=device)
    return known[:count]


_zeros: dict[torch.device, Tensor] = {}


def draw(g: Gaussians, camera: Camera, background: Tensor, antialias: bool, absolute: bool) -> tuple[Render, BackwardPicture]:
    """Draw at least one Gaussian over `background` [3]. See `GsplatRasterizer` for the settings.

    Returns the picture without depth (zeros), and the function that takes the gradients of the picture
    and returns those of the Gaussians; it also fills the picture's `mean2d_grad`.
    """
    library, device, count = _library(), g.means.device, g.means.shape[0]
    camera = camera.to(device, torch.float32)
    width, height = camera.width, camera.height
    view, K = camera.world_to_cam[None], camera.K[None]
    model = library.CameraModelType.PINHOLE
    size = (width, height, BLUR)
    extents, means2d, depths, conics, factors = library.projection_ewa_3dgs_fused_fwd(
        g.means, None, g.quats, g.scales, g.opacities, view, K, *size, camera.near, FAR, 0.0, antialias, model
    )
    radii = find_radii(g.means, g.quats, g.scales, camera, extents)
    colors, opacities = g.colors[None], g.opacities[None]
    if antialias:
        opacities = opacities * factors.clamp_min(MIN_COMPENSATION)
    across, down = -(-width // TILE), -(-height // TILE)
    _, keys, order = library.intersect_tile(means2d, extents, depths, None, None, 1, TILE, across, down, True, False)
    offsets = library.intersect_offset(keys, 1, across, down)
    blended = (means2d, conics, colors, opacities, background[None], None, width, height, TILE, offsets, order)
    picture, alpha, last = library.rasterize_to_pixels_3dgs_fwd(*blended)
    mean2d_grad = g.means.new_empty(count, 2)
    shade = alpha[0, ..., 0]

    def backward(d_picture: Tensor) -> GaussianGradients:
        no_alpha = _nothing(height * width, device).view(1, height, width, 1)
        sums, d_means2d, d_conics, d_colors, d_opacities = library.rasterize_to_pixels_3dgs_bwd(
            *blended, alpha, last, d_picture[None], no_alpha, absolute
        )
        d_factors = None
        if antialias:
            d_factors = d_opacities * g.opacities * (factors >= MIN_COMPENSATION)
            d_opacities = d_opacities * factors.clamp_min(MIN_COMPENSATION)
        d_means, _, d_quats, d_scales, _ = library.projection_ewa_3dgs_fused_bwd(
            g.means, None, g.quats, g.scales, view, K, *size, model, extents, conics, factors if antialias else None,
            d_means2d, _nothing(count, device)[None], d_conics, d_factors, False,
        )  # fmt: skip
        torch.mul((sums if absolute else d_means2d)[0], _half_sides(width, height, device), out=mean2d_grad)
        return GaussianGradients(d_means, d_quats, d_scales, d_opacities[0], d_colors[0])

    return Render(picture[0], shade, _zero(device).expand(height, width), radii, mean2d_grad), backward
