# pyright: basic, reportMissingImports=false
"""Triton kernel of the densification statistics of a view; `observe.py` launches it, and has the
same in plain torch. Each row and slot occurs at most once in a view, so no sum uses atomics."""

from __future__ import annotations

import triton
import triton.language as tl


@triton.jit(do_not_specialize=["A", "M"])
def observe(
    rows, raw, radii, grad2d, source, visits, opacity, grad, count, A, M,
    ANCHORS: tl.constexpr, K: tl.constexpr, B: tl.constexpr, KP: tl.constexpr, BM: tl.constexpr,
):  # fmt: skip
    """Add a view to `visits` [N] and `opacity` [N], if ANCHORS, and to `grad` [N K] and `count` [N
    K].

    A program adds B of the A anchors in `rows` with their opacities `raw` [A, K], and BM of the M
    Gaussians with their `radii` [M], `grad2d` [M, 2] and slots `source` [M].
    """
    if ANCHORS:
        anchor = tl.program_id(0) * B + tl.arange(0, B)
        inside = anchor < A
        row = tl.load(rows + anchor, mask=inside, other=0)
        slot = tl.arange(0, KP)[None, :]
        o = tl.load(raw + anchor.to(tl.int64)[:, None] * K + slot, mask=inside[:, None] & (slot < K), other=0.0)
        tl.store(visits + row, tl.load(visits + row, mask=inside) + 1.0, mask=inside)
        tl.store(opacity + row, tl.load(opacity + row, mask=inside) + tl.sum(tl.where(o < 0, 0.0, o), axis=1), mask=inside)
    at = tl.program_id(0) * BM + tl.arange(0, BM)
    seen = at < M
    seen = seen & (tl.load(radii + at, mask=seen, other=0) > 0)
    to = tl.load(source + at, mask=seen, other=0)
    x, y = tl.load(grad2d + 2 * at, mask=seen, other=0.0), tl.load(grad2d + 2 * at + 1, mask=seen, other=0.0)
    tl.store(grad + to, tl.load(grad + to, mask=seen) + tl.sqrt_rn(x * x + y * y), mask=seen)
    tl.store(count + to, tl.load(count + to, mask=seen) + 1.0, mask=seen)
