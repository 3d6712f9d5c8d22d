"""The 3D smoothing filter of Mip-Splatting (Yu et al., CVPR 2024, section 4.1).

A training view samples the scene at intervals of T = z / f world units: one pixel at depth z and
focal length f. Details smaller than the finest of these intervals cannot be observed, so the filter
adds the variance s T^2 to every Gaussian. Its opacity is multiplied by sqrt(det Sigma / det
Sigma'). Without the filter, Gaussians may be thinner than a pixel of any training view, which shows
when the camera comes closer or the focal length grows. T is a constant of the anchor, whose
Gaussians lie near it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import torch
from torch import Tensor

from scene_experts.core.types import Camera, Decoded

MARGIN = 0.15  # of the picture's sides: a view also samples points this far outside of the picture


@torch.no_grad()
def find_intervals(xyz: Tensor, cameras: Sequence[Camera]) -> Tensor:
    """Return the finest sampling interval T of points xyz [N, 3] in the views of the cameras, [N],
    world units.

    Points that no view sees have the coarsest interval of the others, and 0 if there are no others.
    """
    finest = xyz.new_full((len(xyz),), torch.inf)
    for camera in cameras:
        camera = camera.to(xyz.device, xyz.dtype)
        x, y, z = (xyz @ camera.world_to_cam[:3, :3].T + camera.world_to_cam[:3, 3]).unbind(1)
        seen, depth = z > camera.near, z.clamp_min(camera.near)
        sides = ((x, camera.fx, camera.cx, camera.width), (y, camera.fy, camera.cy, camera.height))
        for place, focal, centre, side in sides:
            pixel = focal * place / depth + centre
            seen &= (pixel >= -MARGIN * side) & (pixel <= (1 + MARGIN) * side)
        interval = depth / max(camera.fx, camera.fy)
        finest = torch.where(seen, torch.minimum(finest, interval), finest)
    known = finest.isfinite()
    return torch.where(known, finest, finest[known].max() if known.any() else 0.0)


def smooth(decoded: Decoded, intervals: Tensor | None, variance: float, K: int) -> Decoded:
    """Apply the filter to the Gaussians. intervals [N]: T of the rows; None: no filter. variance:
    s, in squared intervals."""
    if intervals is None:
        return decoded
    g = decoded.gaussians
    added = variance * intervals.square().index_select(0, torch.div(g.source, K, rounding_mode="floor"))
    scales = (g.scales.square() + added[:, None]).sqrt()
    opacities = g.opacities * (g.scales / scales).prod(1)
    return replace(decoded, gaussians=replace(g, scales=scales, opacities=opacities))
