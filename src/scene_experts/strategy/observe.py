"""Densification statistics, collected once per iteration for all anchor methods.

Statistics of a table:

- `visits` [N]: number of views that saw the anchor.
- `opacity` [N]: sum of the anchor's positive opacities over these views.
- `grad` [N, K]: sum of the norms of the slot's 2D-mean gradients (NDC units).
- `count` [N, K]: number of views that drew the slot.
"""

from __future__ import annotations

import importlib
from functools import cache

import torch
from torch import Tensor

from scene_experts.core.errors import InputError
from scene_experts.core.table import Table
from scene_experts.core.types import Decoded, Render
from scene_experts.native import library as native
from scene_experts.native import triton

ANCHORS, DRAWN = 64, 256  # anchors and Gaussians of a program of the Triton kernel
STATS = ("visits", "opacity", "grad", "count")


def start(table: Table, K: int) -> None:
    """Create the statistics, filled with zeros, in the dtype of the parameters."""
    like = next(iter(table.params.values()))
    for name, shape in (("visits", ()), ("opacity", ()), ("grad", (K,)), ("count", (K,))):
        table.stats[name] = like.new_zeros(len(table), *shape)


def stop(table: Table) -> None:
    """Free the statistics."""
    for name in STATS:
        table.stats.pop(name, None)


@torch.no_grad()
def observe(table: Table, decoded: Decoded, render: Render) -> None:
    """Add one view, after its backward pass. A slot counts if its opacity is positive and its splat
    overlaps the image.

    Each row and slot occurs at most once per view, so the compiled library adds them in parallel.
    Its results are bit-identical to the PyTorch implementation.
    """
    assert decoded.raw_opacity is not None
    raw, library = decoded.raw_opacity.detach(), native.load()
    columns = [table.stats[name] for name in STATS]
    rows, slots = (len(table),), (len(table), raw.shape[1])
    if [tuple(column.shape) for column in columns] != [rows, rows, slots, slots]:
        found = ", ".join(str(list(column.shape)) for column in columns)
        raise InputError(f"expected statistics of {rows[0]:,} rows and {slots[1]} slots each, found {found}; begin the training anew")
    parts = [*columns, raw, render.mean2d_grad]
    if triton.covers(*parts):
        return _launch(table.stats, decoded, render, raw.contiguous())
    if library is None or not all(t.device.type == "cpu" and t.dtype == torch.float32 and t.is_contiguous() for t in parts):
        return _by_torch(table.stats, decoded, render)
    visits, opacity = native.pointer(table.stats["visits"]), native.pointer(table.stats["opacity"])
    drawn = decoded.rows.contiguous()
    library.se_observe_rows(native.pointer(drawn), native.pointer(raw), len(drawn), raw.shape[1], visits, opacity, native.count_threads())
    observe_drawn(table.stats, decoded, render)


@torch.no_grad()
def observe_drawn(stats: dict[str, Tensor], decoded: Decoded, render: Render) -> None:
    """Add one view to `grad` and `count` only (one value per slot). Explicit Gaussians need no
    other statistics."""
    columns, library = [stats["grad"], stats["count"]], native.load()
    parts = [*columns, render.mean2d_grad]
    if triton.covers(*parts):
        return _launch(stats, decoded, render, None)
    if library is None or not all(t.device.type == "cpu" and t.dtype == torch.float32 and t.is_contiguous() for t in parts):
        return _drawn_by_torch(stats, decoded, render)
    radii, source = render.radii.int().contiguous(), decoded.gaussians.source.contiguous()
    drawn = [native.pointer(t) for t in (radii, render.mean2d_grad, source)]
    library.se_observe_drawn(*drawn, len(source), *[native.pointer(t) for t in columns], native.count_threads())


def _launch(stats: dict[str, Tensor], decoded: Decoded, render: Render, raw: Tensor | None) -> None:
    """Triton implementation, one kernel. raw [A, K]: the opacities of the anchors; None: only the
    drawn slots are counted."""
    A, M = 0 if raw is None else len(raw), len(decoded.gaussians)
    K = 1 if raw is None else raw.shape[1]
    programs = max(-(-A // ANCHORS), -(-M // DRAWN))
    if not programs:
        return
    rows, source = decoded.rows.contiguous(), decoded.gaussians.source.contiguous()
    seen = (rows, source if raw is None else raw, render.radii.int().contiguous(), render.mean2d_grad.contiguous(), source)
    of_rows = [stats[name] if raw is not None else source for name in ("visits", "opacity")]
    _kernel(raw is not None, K)((programs,), *seen, *of_rows, stats["grad"], stats["count"], A, M)


@cache
def _kernel(anchors: bool, K: int) -> triton.Launch:
    kernel = importlib.import_module("scene_experts.strategy.triton_observe").observe
    return triton.Launch(kernel, ANCHORS=anchors, K=K, B=ANCHORS, KP=1 << max(K - 1, 0).bit_length(), BM=DRAWN)


def _by_torch(stats: dict[str, Tensor], decoded: Decoded, render: Render) -> None:
    """PyTorch implementation of `observe`, for any device and dtype."""
    rows = decoded.rows
    assert decoded.raw_opacity is not None
    stats["visits"].index_add_(0, rows, torch.ones_like(rows, dtype=stats["visits"].dtype))
    stats["opacity"].index_add_(0, rows, decoded.raw_opacity.detach().clamp_min(0).sum(1))
    _drawn_by_torch(stats, decoded, render)


def _drawn_by_torch(stats: dict[str, Tensor], decoded: Decoded, render: Render) -> None:
    drawn, source = render.radii > 0, decoded.gaussians.source
    norms = render.mean2d_grad.norm(dim=1)
    # Add zeros for slots that were not drawn. Selecting the drawn slots would synchronise the host
    # with the GPU.
    stats["grad"].view(-1).index_add_(0, source, torch.where(drawn, norms, 0.0))
    stats["count"].view(-1).index_add_(0, source, drawn.to(norms.dtype))
