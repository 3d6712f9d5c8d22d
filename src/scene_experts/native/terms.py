"""Sums of the objective over Gaussians and opacities, natively: one pass forward, one backward, autograd's own gradient to the bit."""

from __future__ import annotations

import ctypes
from functools import cache
from typing import Any

import torch
from torch import Tensor

from scene_experts.native import library as native


def covers(values: Tensor) -> bool:
    """Whether the compiled library can sum over `values`: float32 on the CPU."""
    return values.device.type == "cpu" and values.dtype == torch.float32 and _library() is not None


def volume_sum(scales: Tensor) -> Tensor:
    """Sum of sx sy sz over scales [M, 3], []."""
    return _Volume.apply(scales)


def hinge_sum(raw: Tensor, tau: float) -> Tensor:
    """Sum of max(0, tau - raw) over `raw` of any shape, []."""
    return _Hinge.apply(raw, tau)


class _Volume(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, scales: Tensor) -> Tensor:
        scales = scales.detach().contiguous()
        ctx.save_for_backward(scales)
        partial = _partial(len(scales))
        _loaded().se_volume(native.pointer(scales), len(scales), native.pointer(partial), native.threads())
        return partial.sum().float()

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, *upstream: Tensor) -> Tensor:  # pyright: ignore[reportIncompatibleMethodOverride]
        (scales,) = ctx.saved_tensors
        gradient = torch.empty_like(scales)
        up = float(upstream[0])
        _loaded().se_volume_backward(native.pointer(scales), len(scales), up, native.pointer(gradient), native.threads())
        return gradient


class _Hinge(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, raw: Tensor, tau: float) -> Tensor:
        raw, ctx.tau = raw.detach().contiguous(), tau
        ctx.save_for_backward(raw)
        partial = _partial(raw.numel())
        _loaded().se_hinge(native.pointer(raw), raw.numel(), tau, native.pointer(partial), native.threads())
        return partial.sum().float()

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, *upstream: Tensor) -> tuple[Tensor, None]:  # pyright: ignore[reportIncompatibleMethodOverride]
        (raw,) = ctx.saved_tensors
        gradient = torch.empty_like(raw)
        up = float(upstream[0])
        _loaded().se_hinge_backward(native.pointer(raw), raw.numel(), ctx.tau, up, native.pointer(gradient), native.threads())
        return gradient, None


def _partial(count: int) -> Tensor:
    """Room for the partial sums over `count` values."""
    return torch.empty(_loaded().se_term_chunks(count), dtype=torch.float64)


def _loaded() -> ctypes.CDLL:
    library = _library()
    assert library is not None
    return library


@cache
def _library() -> ctypes.CDLL | None:
    address, count, real, threads = ctypes.c_void_p, ctypes.c_int64, ctypes.c_float, ctypes.c_int32
    library = native.bound(
        {
            "se_volume": [address, count, address, threads],
            "se_volume_backward": [address, count, real, address, threads],
            "se_hinge": [address, count, real, address, threads],
            "se_hinge_backward": [address, count, real, real, address, threads],
        }
    )
    if library is not None:
        library.se_term_chunks.argtypes, library.se_term_chunks.restype = [count], count
    return library
