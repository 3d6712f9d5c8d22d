"""Drawing on CUDA with gsplat (Apache-2.0), called so that its pictures and gradients mean what `reference` defines.

What the adapter settles: near plane and blur are the reference's; `radii` are the 3 sigma rule whatever extent gsplat bins with (from
1.5 on less for faint Gaussians, and none below opacity 1/255); what has no radius is not drawn; depth is one more colour channel over a
background of 0; the gradient of the 2D mean is turned from pixels to NDC; the antialias factor is floored at 0.005.
What stays different with gsplat 1.5.3: alpha is clamped at 0.999 instead of 0.99 (from 1.6 on: 0.99); a pixel stops at T <= 1e-4 instead of
below 1e-4; quaternions are normalised inside, so their gradient has no part along the quaternion; sums on the GPU vary in the last bits.
gsplat is imported at the first use; without a prebuilt wheel that compiles its CUDA code, which takes minutes once.
"""

from __future__ import annotations

import functools
import importlib
import inspect
from dataclasses import dataclass, field
from types import ModuleType

import torch
from torch import Tensor

from scene_experts.core.errors import InputError
from scene_experts.core.types import Camera, Gaussians, Render
from scene_experts.render.reference import BLUR, MIN_COMPENSATION, TILE, ReferenceRasterizer, project, visible, watch_mean2d


@functools.cache
def available() -> str | None:
    """None where gsplat can draw; else one sentence that says why not and what to do."""
    if not torch.cuda.is_available():
        return "gsplat needs a CUDA device and a CUDA build of torch, and torch finds none: use the cpu rasteriser"
    try:
        module = importlib.import_module("gsplat")
        backend = importlib.import_module("gsplat.cuda._backend")
    except Exception as error:  # a broken CUDA toolkit raises almost anything while gsplat compiles
        reason = str(error).strip().splitlines()[-1:] or [type(error).__name__]
        return f"gsplat cannot be imported ({reason[0]}): install it with `pip install scene-experts[cuda]`, or use another rasteriser"
    if "opacities" not in inspect.signature(module.fully_fused_projection).parameters:
        found = getattr(module, "__version__", "an older one")
        return f"gsplat 1.5.3 or newer is needed, found {found}: run `pip install -U gsplat`"
    if getattr(backend, "_C", module) is None:
        return "gsplat is installed without its CUDA code: install the CUDA toolkit (nvcc) or a prebuilt gsplat wheel"
    return None


@dataclass(frozen=True)
class GsplatRasterizer:
    """Draws with gsplat on a CUDA device, in float32."""

    antialias: bool = False
    name: str = field(default="gsplat", init=False)

    def __call__(self, g: Gaussians, camera: Camera, background: Tensor) -> Render:
        """Draws M Gaussians over `background` [3]; see `types.Render`. InputError where gsplat cannot run."""
        library = _library()
        if len(g) == 0:
            return ReferenceRasterizer()(g, camera, background)
        camera = camera.to(g.means.device, torch.float32)
        with torch.no_grad():
            radii = project(g.means, g.quats, g.scales, camera).radii
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
        )  # [1, M, 2], [1, M, 2], [1, M], [1, M, 3], [1, M]; for one view
        extents = extents * (radii > 0)[None, :, None].to(extents)
        opacities = g.opacities[None]
        if self.antialias:
            opacities = opacities * compensations.clamp_min(MIN_COMPENSATION)
        mean2d = means2d[0]
        grad = watch_mean2d(mean2d, (g.scales, g.quats, g.opacities, g.colors), camera, len(g), slice(None))
        colors = torch.cat([g.colors, depths[0, :, None]], dim=1)[None]  # [1, M, 4]
        picture, alpha = _rasterize(library, mean2d[None], conics, colors, opacities, extents, depths, camera, background)
        return Render(picture[..., :3], alpha, picture[..., 3], radii, grad)

    def visible(self, means: Tensor, scales: Tensor, camera: Camera) -> Tensor:
        """Whether Gaussians with unrotated axes at `means` [A, 3] with `scales` [A, 3] would be drawn (radius > 0), [A] bool."""
        return visible(means, scales, camera)


def _library() -> ModuleType:
    reason = available()
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
) -> tuple[Tensor, Tensor]:
    """Sorts into tiles and blends one view: the picture [H, W, 4] (colour and depth) and alpha [H, W]."""
    across, down = -(-camera.width // TILE), -(-camera.height // TILE)
    _, keys, order = library.isect_tiles(means2d, extents, depths, TILE, across, down)
    offsets = library.isect_offset_encode(keys, 1, across, down).reshape(1, down, across)
    behind = torch.cat([background.to(colors), colors.new_zeros(1)])[None]  # nothing behind the scene has depth
    picture, alpha = library.rasterize_to_pixels(
        means2d, conics, colors, opacities, camera.width, camera.height, TILE, offsets, order, backgrounds=behind
    )
    return picture[0], alpha[0, ..., 0]
