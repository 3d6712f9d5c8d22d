"""L1 and SSIM, as of commit da16e27: Triton kernels on CUDA, plain torch elsewhere."""

from __future__ import annotations

import importlib
import math
from functools import cache
from typing import Any

import torch
from torch import Tensor
from torch.nn import functional

from peer_cuda import device

TAPS, SIGMA, C1, C2 = 11, 1.5, 0.01**2, 0.03**2
TILE, BLOCK = 64, 1024  # pixels along a side of a tile of the first kernel, values per program of the second
PRECISION = "tf32x3"  # of the windows' products
WARPS = 8


def photometric(
    image: Tensor, target: Tensor, lambda_dssim: float, mask: Tensor | None = None, form: str = "triton"
) -> tuple[Tensor, Tensor]:
    """(1 - lambda) L1 and lambda (1 - SSIM), both []. Images [H, W, 3], mask [H, W] or None. form: "triton" where it runs, or "torch"."""
    if mask is not None:
        image = torch.lerp(target, image, mask.to(image.dtype)[..., None])
    fused = form == "triton" and device.covers(image, target)
    both = Photometric.apply(image, target, lambda_dssim) if fused else by_torch(image, target, lambda_dssim)
    if mask is None:
        return both
    share = mask.to(both[0].dtype).mean().clamp_min(1e-12)
    return both[0] / share, both[1] / share


def by_torch(image: Tensor, target: Tensor, lambda_dssim: float) -> tuple[Tensor, Tensor]:
    """The same terms by torch's convolutions, in the formulation that most trainers of Gaussians use."""
    x, y = image.movedim(2, 0)[None], target.movedim(2, 0)[None]  # [1, 3, H, W]
    window = _window(x.dtype, x.device)
    mx, my, xx, yy, xy = (functional.conv2d(t, window, padding=TAPS // 2, groups=3) for t in (x, y, x * x, y * y, x * y))
    vx, vy, cov = xx - mx * mx, yy - my * my, xy - mx * my
    ssim = (2 * mx * my + C1) * (2 * cov + C2) / ((mx * mx + my * my + C1) * (vx + vy + C2))
    return (1 - lambda_dssim) * (image - target).abs().mean(), lambda_dssim * (1 - ssim.mean())


@cache
def _window(dtype: torch.dtype, device: torch.device) -> Tensor:
    t = torch.arange(TAPS, dtype=torch.float64) - TAPS // 2
    w = torch.exp(-t * t / (2 * SIGMA * SIGMA))
    w = w / w.sum()
    return (w[:, None] * w[None]).to(device, dtype).repeat(3, 1, 1, 1)


class Photometric(torch.autograd.Function):
    """Both terms and the gradient of 1 - SSIM in one kernel. The backward pass adds that of L1 in another."""

    @staticmethod
    def forward(ctx: Any, image: Tensor, target: Tensor, lambda_dssim: float) -> tuple[Tensor, Tensor]:
        x, y = image.detach().contiguous(), target.detach().contiguous()
        H, W, _ = x.shape
        weights, wanted = ((1 - lambda_dssim) / x.numel(), lambda_dssim / x.numel()), ctx.needs_input_grad[0]
        gradient = torch.empty_like(x) if wanted else x
        grid = (-(-W // (TILE - 2 * TAPS + 2)), -(-H // (TILE - 2 * TAPS + 2)), 3)
        sums = torch.empty(math.prod(grid), 2, dtype=x.dtype, device=x.device)
        scale, reach = 1 / (2 * SIGMA * SIGMA), TAPS // 2
        norm = sum(math.exp(-scale * t * t) for t in range(-reach, reach + 1))
        sizes = {"R": reach, "SCALE": scale, "NORM": norm, "C1": C1, "C2": C2, "T": TILE, "WANTED": wanted, "PRECISION": PRECISION}
        device.launch(_kernels().loss_forward, grid, x, y, gradient, sums, H, W, *weights, **sizes, num_warps=WARPS)
        ctx.l1_weight = weights[0]
        if wanted:
            ctx.save_for_backward(x, y, gradient)
        l1_term, dssim_term = sums.sum(0).unbind(0)
        return l1_term, dssim_term

    @staticmethod
    def backward(ctx: Any, *upstream: Tensor) -> tuple[Tensor, None, None]:
        x, y, gradient = ctx.saved_tensors
        out, n = torch.empty_like(x), x.numel()
        scales = (g.contiguous() for g in upstream)
        device.launch(_kernels().loss_backward, (-(-n // BLOCK),), x, y, gradient, *scales, out, n, ctx.l1_weight, B=BLOCK)
        return out, None, None


def _kernels() -> Any:
    return importlib.import_module("peer_cuda.kernels")
