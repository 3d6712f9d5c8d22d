"""L1 and SSIM: the photometric loss of 3DGS as two terms.

Images are [H, W, 3] float RGB in [0, 1]. float32 on the CPU uses one call of the compiled library.
Other inputs use plain torch.
"""

from __future__ import annotations

import importlib
import math
from functools import cache
from typing import Any

import torch
from torch import Tensor
from torch.nn import functional

from scene_experts.native import library as native
from scene_experts.native import triton

TAPS, SIGMA, C1, C2 = 11, 1.5, 0.01**2, 0.03**2


def l1(image: Tensor, target: Tensor) -> Tensor:
    """Mean absolute difference over pixels and channels, []."""
    return (image - target).abs().sum() / max(image.numel(), 1)


def ssim(image: Tensor, target: Tensor) -> Tensor:
    """Structural similarity, []. It is 1 for equal images.

    The window is an 11 x 11 Gaussian with sigma 1.5 and zero padding. Variances are biased. The
    result is the mean over pixels and channels (Wang et al. 2004 with the padding of 3DGS). It is
    differentiable in both images.

    Args:
        image: [H, W, 3] of any size, device and floating-point dtype.
        target: [H, W, 3], the same shape, device and dtype.
    """
    return 1 - dissimilarity(image, target)


def dissimilarity(image: Tensor, target: Tensor) -> Tensor:
    """1 - SSIM, []. The formula does not lose float32 precision if the images are nearly equal.

    With the sum s and the difference d of the images: S = (1 - p)(1 - q), p = E[d]^2 / (mx^2 + my^2
    + C1) and q = var(d) / (var(x) + var(y) + C2), where mx^2 + my^2 = (E[s]^2 + E[d]^2) / 2. The
    same identity holds for the variances.
    """
    s, d = (image + target - 1).movedim(2, 0), (image - target).movedim(2, 0)  # [3, H, W]
    # Subtracting 1 from the sum and its padding keeps the variance and makes the squares smaller.
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
    """Return the one-dimensional factor of the window, repeated for 12 maps, [12, 1, TAPS]."""
    t = torch.arange(TAPS, dtype=torch.float64) - TAPS // 2
    w = torch.exp(-t * t / (2 * SIGMA * SIGMA))
    return (w / w.sum()).to(device, dtype).repeat(12, 1, 1)


def photometric(image: Tensor, target: Tensor, lambda_dssim: float, mask: Tensor | None = None) -> tuple[Tensor, Tensor]:
    """Photometric loss of 3DGS as two terms: (1 - lambda) L1 and lambda (1 - SSIM), both [].

    float32 on the CPU uses one call of the compiled library for values and gradient, and on CUDA
    one Triton kernel. Other inputs, and a target that requires a gradient, use plain torch.

    Args:
        image: [H, W, 3], the rendered image.
        target: [H, W, 3], the photograph.
        lambda_dssim: Weight of 1 - SSIM, 0 to 1.
        mask: [H, W] in [0, 1]; pixels with 0 are ignored. The target replaces the image at ignored
            pixels, and both terms are divided by the mean of the mask.

    Raises ValueError unless image and target have the same shape, with three channels.
    """
    if image.shape != target.shape or image.dim() != 3 or image.shape[-1] != 3:
        raise ValueError(f"expected an image and a target of one shape [H, W, 3], found {list(image.shape)} and {list(target.shape)}")
    if mask is not None:
        image = torch.lerp(target, image, mask.to(image.dtype)[..., None])
    if triton.covers(image, target) and not target.requires_grad and image.numel() > 0:
        both = _PhotometricCuda.apply(image, target, float(lambda_dssim))
        return both if mask is None else _divide_by_mean(both, mask)
    fused = image.device.type == "cpu" and image.dtype == target.dtype == torch.float32 and not target.requires_grad and image.numel() > 0
    if fused and native.load() is not None:
        both = _Photometric.apply(image, target, float(lambda_dssim))
    else:
        both = ((1 - lambda_dssim) * l1(image, target), lambda_dssim * dissimilarity(image, target))
    return both if mask is None else _divide_by_mean(both, mask)


def _divide_by_mean(both: tuple[Tensor, Tensor], mask: Tensor) -> tuple[Tensor, Tensor]:
    share = mask.to(both[0].dtype).mean().clamp_min(1e-12)
    return both[0] / share, both[1] / share


class _Photometric(torch.autograd.Function):
    """Compute both terms and the gradient of their sum in one pass over the image. The backward
    pass only scales the gradient."""

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
        if by_l1 != by_dssim:  # the stored gradient weighs both terms equally; the L1 part is cheap to recompute
            out = torch.add(out, (x - y).sign_(), alpha=(by_l1 - by_dssim) * ctx.l1_weight / x.numel())
        return out, None, None


TILE, WARPS, BLOCK = 32, 8, 1024  # pixels along a side of a tile of the first kernel and its warps, values per program of the second
PRECISION = (
    "ieee"  # of the windows' products: float32; for 800x533 on an H100 and with 4 warps 0.50 ms, tf32x3 0.70, tile 64 and tf32x3 1.16
)


class _PhotometricCuda(torch.autograd.Function):
    """Compute both terms and the gradient of 1 - SSIM in one kernel. The backward pass adds the
    gradient of L1 in another one."""

    @staticmethod
    def forward(ctx: Any, image: Tensor, target: Tensor, lambda_dssim: float) -> tuple[Tensor, Tensor]:
        x, y = image.detach().contiguous(), target.detach().contiguous()
        wanted = ctx.needs_input_grad[0]
        sums, gradient, l1_weight = _launch_forward(x, y, lambda_dssim, wanted)
        ctx.l1_weight = l1_weight
        if wanted:
            ctx.save_for_backward(x, y, gradient)
        l1_term, dssim_term = sums.sum(0).unbind(0)
        return l1_term, dssim_term

    @staticmethod
    def backward(ctx: Any, *upstream: Tensor) -> tuple[Tensor, None, None]:
        x, y, gradient = ctx.saved_tensors
        out, n = torch.empty_like(x), x.numel()
        scales = (g.contiguous() for g in upstream)
        triton.launch(_kernels().backward, (-(-n // BLOCK),), x, y, gradient, *scales, out, n, ctx.l1_weight, B=BLOCK)
        return out, None, None


def _launch_forward(x: Tensor, y: Tensor, lambda_dssim: float, wanted: bool, both: bool = False) -> tuple[Tensor, Tensor, float]:
    """Return the parts of both terms [programs, 2], the gradient of 1 - SSIM (or of both terms), if
    it is wanted, and the weight of a value's L1."""
    H, W, _ = x.shape
    weights = ((1 - lambda_dssim) / x.numel(), lambda_dssim / x.numel())
    gradient = torch.empty_like(x) if wanted else x
    grid = (-(-W // (TILE - 2 * TAPS + 2)), -(-H // (TILE - 2 * TAPS + 2)), 3)
    sums = torch.empty(math.prod(grid), 2, dtype=x.dtype, device=x.device)
    _forward(TILE, wanted, both, PRECISION, WARPS)(grid, x, y, gradient, sums, H, W, *weights)
    return sums, gradient, weights[0]


@cache
def _forward(tile: int, wanted: bool, both: bool, precision: str, warps: int) -> triton.Launch:
    scale, reach = 1 / (2 * SIGMA * SIGMA), TAPS // 2
    norm = sum(math.exp(-scale * t * t) for t in range(-reach, reach + 1))
    sizes = {"R": reach, "SCALE": scale, "NORM": norm, "C1": C1, "C2": C2, "T": tile, "WANTED": wanted, "BOTH": both}
    return triton.Launch(_kernels().forward, **sizes, PRECISION=precision, num_warps=warps)


def photometric_gradients(image: Tensor, target: Tensor, lambda_dssim: float, mask: Tensor | None = None) -> Tensor:
    """Return the gradient [H, W, 3] of the sum of both terms of `photometric` in the image, with
    its arguments, without a graph. On CUDA it is one Triton kernel."""
    if not (triton.covers(image, target) and image.numel()):
        with torch.enable_grad():
            leaf = image.detach().requires_grad_()
            l1_term, dssim_term = photometric(leaf, target, lambda_dssim, mask)
            (gradient,) = torch.autograd.grad(l1_term + dssim_term, leaf)
        return gradient
    if mask is None:
        return _launch_forward(image, target, float(lambda_dssim), True, both=True)[1]
    weight = mask.to(image.dtype)
    gradient = _launch_forward(torch.lerp(target, image, weight[..., None]), target, float(lambda_dssim), True, both=True)[1]
    return gradient.mul_((weight / weight.mean().clamp_min(1e-12))[..., None])


@cache
def _kernels() -> Any:
    return importlib.import_module("scene_experts.training.triton_loss")
