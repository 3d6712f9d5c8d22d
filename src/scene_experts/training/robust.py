"""Masks of what moves: pixels with large residuals count less (RobustNeRF, Sabour et al., CVPR
2023, section 3.2)."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn import functional

WINDOW = 3  # px, edge of the window over which the first mask is averaged


@torch.no_grad()
def weigh_residuals(image: Tensor, target: Tensor, quantile: float, weight: float, mask: Tensor | None = None) -> Tensor:
    """Return the weights of the pixels, [H, W]: 1 for most pixels, `weight` for pixels with large
    residuals.

    The residual of a pixel is the mean over the channels of |image - target|. A pixel is an inlier
    if at least half of the 3 x 3 pixels around it have residuals up to the given quantile, so
    single bright pixels and edges keep their weight.

    Args:
        image: [H, W, 3], the rendered image.
        target: [H, W, 3], the photograph.
        quantile: Share of the pixels with small residuals, 0 to 1.
        weight: Weight of the other pixels, 0 to 1.
        mask: [H, W] in [0, 1]; the quantile is over the pixels above 0, and the weights are
            multiplied by it.
    """
    residual = (image.detach() - target).abs().mean(2)
    known = residual if mask is None else residual[mask > 0]
    if not known.numel():
        return torch.ones_like(residual) if mask is None else mask.to(residual.dtype)
    place = max(1, min(known.numel(), round(quantile * known.numel())))
    small = (residual <= known.flatten().kthvalue(place).values).to(residual.dtype)
    near = functional.avg_pool2d(small[None, None], WINDOW, 1, WINDOW // 2, count_include_pad=False)[0, 0]
    weights = torch.where(near >= 0.5, 1.0, weight).to(residual.dtype)
    return weights if mask is None else weights * mask.to(residual.dtype)
