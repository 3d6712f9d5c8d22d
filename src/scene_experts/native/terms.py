"""Two sums of the objective in the compiled library: volumes of Gaussians and the opacity hinge.
Gradients equal autograd's bit for bit."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from scene_experts.native import library as native


def covers(values: Tensor) -> bool:
    """Whether the compiled library can sum over `values`: float32 on the CPU."""
    return values.device.type == "cpu" and values.dtype == torch.float32 and native.load() is not None


def sum_volumes(scales: Tensor) -> Tensor:
    """Sum of sx sy sz over scales [M, 3], []."""
    return _Volume.apply(scales)


def sum_hinge(raw: Tensor, tau: float) -> Tensor:
    """Sum of max(0, tau - raw) over `raw` of any shape, []."""
    return _Hinge.apply(raw, tau)


class _Volume(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, scales: Tensor) -> Tensor:
        scales = scales.detach().contiguous()
        ctx.save_for_backward(scales)
        partial = _allocate_partial(len(scales))
        native.require().se_volume_forward(native.pointer(scales), len(scales), native.pointer(partial), native.count_threads())
        return partial.sum().float()

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, *upstream: Tensor) -> Tensor:  # pyright: ignore[reportIncompatibleMethodOverride]
        (scales,) = ctx.saved_tensors
        gradient = torch.empty_like(scales)
        up = float(upstream[0])
        native.require().se_volume_backward(native.pointer(scales), len(scales), up, native.pointer(gradient), native.count_threads())
        return gradient


class _Hinge(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, raw: Tensor, tau: float) -> Tensor:
        raw, ctx.tau = raw.detach().contiguous(), tau
        ctx.save_for_backward(raw)
        partial = _allocate_partial(raw.numel())
        native.require().se_hinge_forward(native.pointer(raw), raw.numel(), tau, native.pointer(partial), native.count_threads())
        return partial.sum().float()

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, *upstream: Tensor) -> tuple[Tensor, None]:  # pyright: ignore[reportIncompatibleMethodOverride]
        (raw,) = ctx.saved_tensors
        gradient = torch.empty_like(raw)
        up = float(upstream[0])
        native.require().se_hinge_backward(native.pointer(raw), raw.numel(), ctx.tau, up, native.pointer(gradient), native.count_threads())
        return gradient, None


def _allocate_partial(count: int) -> Tensor:
    """Memory for the partial sums over `count` values."""
    return torch.empty(native.require().se_sum_chunks(count), dtype=torch.float64)
