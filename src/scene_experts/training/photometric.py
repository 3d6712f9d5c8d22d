"""L1 and SSIM: 3DGS's photometric loss as two terms.

Pictures are [H, W, 3] float RGB in [0, 1]. float32 on the CPU is one call of the compiled library; the rest is plain torch.
"""

from __future__ import annotations

from functools import cache
from typing import Any

import torch
from torch import Tensor
from torch.nn import functional

from scene_experts.native import library as native

TAPS, SIGMA, C1, C2 = 11, 1.5, 0.01**2, 0.03**2


def l1(image: Tensor, target: Tensor) -> Tensor:
    """Mean absolute difference over pixels and channels, []."""
    return (image - target).abs().sum() / max(image.numel(), 1)


def ssim(image: Tensor, target: Tensor) -> Tensor:
    """Structural similarity, [], 1 for equal pictures.

    11 x 11 Gaussian window of sigma 1.5, zero padding, per channel, biased variances, mean over pixels and channels (Wang et al. 2004 with
    the padding of 3DGS). image, target [H, W, 3] of any size, device and floating dtype; differentiable in both.
    """
    return 1 - dissimilarity(image, target)


def dissimilarity(image: Tensor, target: Tensor) -> Tensor:
    """1 - SSIM, [], written so that float32 loses nothing of it where the pictures agree.

    With the sum s and the difference d of the pictures: S = (1 - p)(1 - q), p = E[d]^2 / (mx^2 + my^2 + C1) and
    q = var(d) / (var(x) + var(y) + C2), where mx^2 + my^2 = (E[s]^2 + E[d]^2) / 2 and the same for the variances.
    """
    s, d = (image + target - 1).movedim(2, 0), (image - target).movedim(2, 0)  # [3, H, W]
    # The sum minus 1 (and its padding with it) has the same variance, from smaller squares.
    s, d = functional.pad(s, [TAPS // 2] * 4, value=-1.0), functional.pad(d, [TAPS // 2] * 4)
    window = _window(s.dtype, s.device)
    maps = torch.cat([s, d, s * s, d * d])[None]
    maps = functional.conv2d(functional.conv2d(maps, window[:, :, None], groups=12), window[..., None], groups=12)
    ms, md, ss, dd = maps[0].chunk(4)  # each [3, H, W]
    vd = dd - md * md
    p = md * md / (((ms + 1).square() + md * md) / 2 + C1)
    q = vd / ((ss - ms * ms + vd) / 2 + C2)
    return (p + q - p * q).sum() / max(p.numel(), 1)


@cache
def _window(dtype: torch.dtype, device: torch.device) -> Tensor:
    """The window's one-dimensional factor for each of 12 maps, shaped [12, 1, TAPS]."""
    t = torch.arange(TAPS, dtype=torch.float64) - TAPS // 2
    w = torch.exp(-t * t / (2 * SIGMA * SIGMA))
    return (w / w.sum()).to(device, dtype).repeat(12, 1, 1)


def photometric(image: Tensor, target: Tensor, lambda_dssim: float, mask: Tensor | None = None) -> tuple[Tensor, Tensor]:
    """((1 - lambda) L1, lambda (1 - SSIM)), both []: 3DGS's photometric loss as two terms.

    image, target [H, W, 3]. With mask [H, W] (1 = counts), the render is replaced by the target where nothing counts and both terms are
    divided by the share that counts. float32 on the CPU is one call of the compiled library for values and gradient; anything else, and
    a target that needs a gradient, is plain torch.
    """
    if mask is not None:
        image = torch.lerp(target, image, mask.to(image.dtype)[..., None])
    fused = image.device.type == "cpu" and image.dtype == target.dtype == torch.float32 and not target.requires_grad and image.numel() > 0
    if fused and native.load() is not None:
        both = _Photometric.apply(image, target, float(lambda_dssim))
    else:
        both = ((1 - lambda_dssim) * l1(image, target), lambda_dssim * dissimilarity(image, target))
    if mask is None:
        return both
    share = mask.to(image.dtype).mean().clamp_min(1e-12)
    return both[0] / share, both[1] / share


class _Photometric(torch.autograd.Function):
    """Both terms and the gradient of their sum in one pass over the picture; the backward pass only scales it."""

    @staticmethod
    def forward(ctx: Any, image: Tensor, target: Tensor, lambda_dssim: float) -> tuple[Tensor, Tensor]:
        x, y = image.detach().contiguous(), target.detach().contiguous()
        gradient = torch.empty_like(x) if ctx.needs_input_grad[0] else None
        found = torch.empty(2, dtype=torch.float64)
        H, W, _ = x.shape
        tensors = [native.pointer(t) for t in (x, y, gradient, found)]
        code = native.require().se_photometric_loss(
            *tensors[:2], H, W, 1 - lambda_dssim, lambda_dssim, native.count_threads(), *tensors[2:]
        )
        native.check(code, "the photometric loss")
        ctx.l1_weight = 1 - lambda_dssim
        if gradient is not None:
            ctx.save_for_backward(x, y, gradient)
        return ((1 - lambda_dssim) * found[0]).float(), (lambda_dssim * found[1]).float()

    @staticmethod
    def backward(ctx: Any, *upstream: Tensor) -> tuple[Tensor, None, None]:
        x, y, gradient = ctx.saved_tensors
        by_l1, by_dssim = (float(g) for g in upstream)
        out = gradient if by_dssim == 1 else gradient * by_dssim
        if by_l1 != by_dssim:  # the stored sum holds both terms in equal parts; L1's share is cheap to make again
            out = torch.add(out, (x - y).sign_(), alpha=(by_l1 - by_dssim) * ctx.l1_weight / x.numel())
        return out, None, None
