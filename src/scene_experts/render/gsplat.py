"""Draws on CUDA with gsplat (Apache-2.0), adapted to the pictures and gradients that `reference`
defines.

The adapter uses the near plane and blur of the reference. `radii` follow the 3 sigma rule, and
Gaussians without a radius are not drawn, whatever extent gsplat sorts with (since 1.5 it is smaller
for faint Gaussians and empty below opacity 1/255). Depth, where it is wanted, is a fourth colour
channel over a background of 0. The gradient of the 2D mean is converted from px to NDC. The antialiasing factor is
at least 0.005.

These differences remain with gsplat 1.5.3: alpha is clamped at 0.999 instead of 0.99 (since 1.6 at
0.99). A pixel stops at T <= 1e-4 instead of T < 1e-4. Quaternions are normalised inside, so their
gradient has no component along the quaternion. Where the factor without its floor takes an opacity
below 1/255, nothing is drawn; the reference draws an alpha of at most 0.005. Sums on the GPU are
not deterministic in the last bits.

gsplat is imported on first use, see `gsplat_install`.
"""

from __future__ import annotations

import importlib
from dataclasses import dataclass, field
from types import ModuleType
from typing import Any

import torch
from torch import Tensor

from scene_experts.core.errors import InputError
from scene_experts.core.gradients import BackwardPicture
from scene_experts.core.types import Camera, Gaussians, Render
from scene_experts.native import triton
from scene_experts.render import gsplat_direct
from scene_experts.render.gsplat_install import explain_missing
from scene_experts.render.project_cuda import find_radii
from scene_experts.render.reference import BLUR, MIN_COMPENSATION, TILE, project, record_mean2d_grad, visible


@dataclass(frozen=True)
class GsplatRasterizer:
    """Draws with gsplat on a CUDA device, in float32."""

    antialias: bool = False
    name: str = field(default="gsplat", init=False)
    absolute: bool = False
    depth: bool = True
    """Whether the depth is drawn, as a fourth colour; training does without."""

    def __call__(self, g: Gaussians, camera: Camera, background: Tensor) -> Render:
        """Draw M Gaussians over `background` [3], see `types.Render`. Raises InputError if gsplat
        cannot run."""
        library = _import_gsplat()
        if len(g) == 0:
            return _draw_nothing(g, camera, background)
        camera = camera.to(g.means.device, torch.float32)
        extents, means2d, depths, conics, compensations = library.fully_fused_projection(
            g.means,
            None,
            g.quats,
            g.scales,
            camera.world_to_cam[None],
            camera.K[None],
            camera.width,
            camera.height,
            eps2d=BLUR,
            near_plane=camera.near,
            calc_compensations=self.antialias,
            opacities=g.opacities.detach(),
        )  # [1, M, 2], [1, M, 2], [1, M], [1, M, 3], [1, M] for one view
        radii, extents = _find_radii(g, camera, extents)
        opacities = g.opacities[None]
        if self.antialias:
            opacities = opacities * compensations.clamp_min(MIN_COMPENSATION)
        mean2d = means2d[0]
        instead = (lambda: centres.absgrad[0]) if self.absolute else None  # gsplat's backward pass sets `absgrad`
        grad = record_mean2d_grad(mean2d, (g.scales, g.quats, g.opacities, g.colors), camera, len(g), slice(None), instead)
        centres: Any = mean2d[None]
        colors = (torch.cat([g.colors, depths[0, :, None]], dim=1) if self.depth else g.colors)[None]  # [1, M, 3 or 4]
        picture, alpha = _rasterize(library, centres, conics, colors, opacities, extents, depths, camera, background, self.absolute)
        depth = picture[..., 3] if self.depth else torch.zeros_like(alpha)
        return Render(picture[..., :3], alpha, depth, radii, grad)

    def explain_indirect(self) -> str | None:
        """Return None if `draw_with_gradients` can draw, else the reason."""
        if self.depth:
            return "a picture with depth"
        return triton.explain_missing() or gsplat_direct.explain_unknown()

    def draw_with_gradients(self, g: Gaussians, camera: Camera, background: Tensor) -> tuple[Render, BackwardPicture]:
        """See `render.draw_with_gradients`; at least one Gaussian, float32."""
        return gsplat_direct.draw(g, camera, background, self.antialias, self.absolute)

    def visible(self, means: Tensor, scales: Tensor, camera: Camera) -> Tensor:
        """Return [A] bool: whether unrotated Gaussians at `means` [A, 3] with `scales` [A, 3] are
        drawn (radius > 0)."""
        if triton.covers(means, scales):
            return find_radii(means, None, scales, camera) > 0
        return visible(means, scales, camera)


@torch.no_grad()
def _find_radii(g: Gaussians, camera: Camera, extents: Tensor) -> tuple[Tensor, Tensor]:
    """Return the radii [M] int32 by the 3 sigma rule, and gsplat's extents [1, M, 2] with 0 for
    Gaussians without a radius."""
    if triton.covers(g.means, g.quats, g.scales):
        return find_radii(g.means, g.quats, g.scales, camera, extents), extents
    radii = project(g.means, g.quats, g.scales, camera).radii
    return radii, extents * (radii > 0)[None, :, None].to(extents)


def _draw_nothing(g: Gaussians, camera: Camera, background: Tensor) -> Render:
    """Return the picture of no Gaussians: the background."""
    blank = g.means.new_zeros(camera.height, camera.width)
    picture = background.to(blank) + blank[..., None] + g.colors.sum()  # the sum of nothing keeps the picture in the graph
    return Render(picture, blank, blank, torch.zeros(0, dtype=torch.int32, device=blank.device), g.means.new_zeros(0, 2))


def _import_gsplat() -> ModuleType:
    """Return the module gsplat. Raises InputError if it cannot draw."""
    reason = explain_missing()
    if reason is not None:
        raise InputError(reason)
    return importlib.import_module("gsplat")


def _rasterize(
    library: ModuleType,
    means2d: Tensor,
    conics: Tensor,
    colors: Tensor,
    opacities: Tensor,
    extents: Tensor,
    depths: Tensor,
    camera: Camera,
    background: Tensor,
    absolute: bool,
) -> tuple[Tensor, Tensor]:
    """Sort into tiles and blend one view. Returns the picture [H, W, 3 or 4] (colour, and depth
    where the colours have it) and alpha [H, W].

    `absolute`: the backward pass sets `means2d.absgrad` to the sums of the absolute values of the
    pixels' gradients.
    """
    across, down = -(-camera.width // TILE), -(-camera.height // TILE)
    _, keys, order = library.isect_tiles(means2d, extents, depths, TILE, across, down)
    offsets = library.isect_offset_encode(keys, 1, across, down).reshape(1, down, across)
    behind = background.to(colors)[None]
    if colors.shape[-1] > 3:
        behind = torch.cat([behind, colors.new_zeros(1, 1)], dim=1)  # the background has depth 0
    asked = {"absgrad": True} if absolute else {}
    picture, alpha = library.rasterize_to_pixels(
        means2d, conics, colors, opacities, camera.width, camera.height, TILE, offsets, order, backgrounds=behind, **asked
    )
    return picture[0], alpha[0, ..., 0]
