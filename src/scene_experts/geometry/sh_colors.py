"""Colours of Gaussians from spherical harmonics, with gradients: in the compiled library on the
CPU, else in torch.

Gradients reach the harmonics and, through the viewing direction, the positions (as in 3DGS).
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from scene_experts.geometry.sh import MAX_DEGREE, sh_to_rgb
from scene_experts.native import library as native


def compute_sh_colors(means: Tensor, dc: Tensor, rest: Tensor, rows: Tensor | None, position: Tensor, degree: int) -> Tensor:
    """Colours max(0, harmonics + 0.5), [A, 3], of Gaussians seen from `position` [3].

    means [A, 3] world; dc [N, 3] and rest [N, C - 1, 3] are the harmonics of a table, whose `rows`
    [A] int64 (each at most once; None: all N in order) belong to `means`. `rest` may hold more
    coefficients than `degree` (0 to 3) uses; their gradient is zero.
    """
    if not 0 <= degree <= MAX_DEGREE or rest.shape[1] < (degree + 1) ** 2 - 1:
        raise ValueError(f"expected a degree from 0 to {MAX_DEGREE} that fits {rest.shape[1] + 1} coefficients, found {degree}")
    fits = all(t.device.type == "cpu" and t.dtype == torch.float32 and t.is_contiguous() for t in (means, dc, rest))
    if fits and not position.requires_grad and native.load() is not None:
        return _Colors.apply(means, dc, rest, rows, position, degree)  # type: ignore[return-value]
    return compute_in_torch(means, dc, rest, rows, position, degree)


def compute_in_torch(means: Tensor, dc: Tensor, rest: Tensor, rows: Tensor | None, position: Tensor, degree: int) -> Tensor:
    """The same as `compute_sh_colors` in plain torch, for any device and dtype."""
    sh = torch.cat([dc[:, None], rest], dim=1)
    return sh_to_rgb(sh if rows is None else sh.index_select(0, rows), means - position.to(means), degree)


class _Colors(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, means: Tensor, dc: Tensor, rest: Tensor, rows: Tensor | None, position: Tensor, degree: int) -> Tensor:
        library = native.require()
        rows = None if rows is None else rows.contiguous()
        position = position.detach().to("cpu", torch.float32).contiguous()
        out = torch.empty(len(means), 3)
        *inputs, at, to = (native.pointer(t) for t in (means.detach(), dc.detach(), rest.detach(), rows, position, out))
        library.se_sh_forward(*inputs, len(means), rest.shape[1], degree, at, to, native.count_threads())
        ctx.save_for_backward(means, dc, rest, rows, position, out)
        ctx.degree = degree
        return out

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, upstream: Tensor):  # pyright: ignore[reportIncompatibleMethodOverride]
        means, dc, rest, rows, position, out = ctx.saved_tensors
        library = native.require()
        d_means, d_dc, d_rest = torch.empty_like(means), torch.zeros_like(dc), torch.zeros_like(rest)
        tensors = [means, dc, rest, rows, position, out, upstream.contiguous(), d_means, d_dc, d_rest]
        where = [native.pointer(None if t is None else t.detach()) for t in tensors]
        library.se_sh_backward(*where, len(means), rest.shape[1], ctx.degree, native.count_threads())
        return d_means, d_dc, d_rest, None, None, None
