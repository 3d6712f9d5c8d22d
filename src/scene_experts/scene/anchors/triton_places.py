# pyright: basic, reportMissingImports=false
"""Triton kernels that turn the outputs of the networks into Gaussians and back in the CUDA decode;
`triton_decode` calls them. A program handles B anchors with all of their slots, padded to KP."""

from __future__ import annotations

import triton
import triton.language as tl

from scene_experts.geometry.triton_rotation import write_unit, write_unit_backward
from scene_experts.scene.anchors.triton_kernels import activate


@triton.jit(do_not_specialize=["count"])
def number(raw, counted, dst, count, B: tl.constexpr):
    """Write the index of each slot among the drawn Gaussians, -1 if its opacity `raw` is not
    positive, to `dst`. All are [count]; `counted` are the numbers of drawn slots up to and with each."""
    at = tl.program_id(0) * B + tl.arange(0, B)
    inside = at < count
    drawn = tl.load(raw + at, mask=inside, other=0.0) > 0
    tl.store(dst + at, tl.where(drawn, tl.load(counted + at, mask=inside, other=0) - 1, -1), mask=inside)


@triton.jit(do_not_specialize=["A"])
def place(
    rows, xyz, offsets, log_scaling, raw, cov, dst, means, quats, scales, opacities, source, A,
    K: tl.constexpr, B: tl.constexpr, KP: tl.constexpr,
):  # fmt: skip
    """Write the drawn Gaussians except their colours: means (eq. 2), scales and unit quaternions
    from `cov` [M, 7], opacities, sources."""
    anchor = tl.program_id(0) * B + tl.arange(0, B)
    inside = anchor < A
    row = tl.load(rows + anchor, mask=inside, other=0)
    slot = tl.arange(0, KP)[None, :]
    at = anchor.to(tl.int64)[:, None] * K + slot
    d = tl.load(dst + at, mask=inside[:, None] & (slot < K), other=-1)
    drawn = d >= 0
    own = row[:, None] * K + slot
    tl.store(opacities + d, tl.load(raw + at, mask=drawn, other=0.0), mask=drawn)
    tl.store(source + d, own, mask=drawn)
    for c in tl.static_range(3):
        size = tl.exp(tl.load(log_scaling + row * 6 + c, mask=inside, other=0.0))
        bound = tl.exp(tl.load(log_scaling + row * 6 + 3 + c, mask=inside, other=0.0))
        offset = tl.load(offsets + own * 3 + c, mask=drawn, other=0.0)
        centre = tl.load(xyz + row * 3 + c, mask=inside, other=0.0)
        tl.store(means + d * 3 + c, centre[:, None] + offset * size[:, None], mask=drawn)
        tl.store(scales + d * 3 + c, bound[:, None] * activate(tl.load(cov + d * 7 + c, mask=drawn, other=0.0), 2), mask=drawn)
    write_unit(cov + d * 7 + 3, quats + d * 4, drawn)


@triton.jit(do_not_specialize=["A"])
def place_backward(
    rows, offsets, log_scaling, raw, cov, dst, scales, quats, d_means, d_quats, d_scales, d_opacities, d_raw,
    d_offsets, d_log_scaling, d_cov, d_opacity_head, A, volume, hinge, tau,
    RAW: tl.constexpr, TERMS: tl.constexpr, K: tl.constexpr, B: tl.constexpr, KP: tl.constexpr,
):  # fmt: skip
    """Compute the gradients of offsets, log-scaling, `cov` [M, 7] and the opacities [A, K] of all
    slots from those of the Gaussians.

    RAW: with gradients `d_raw` [A, K] of the opacities. TERMS: add those of two terms of the loss,
    `volume` times the sum of the Gaussians' volumes, and `hinge` times the sum of max(0, tau - raw).
    """
    anchor = tl.program_id(0) * B + tl.arange(0, B)
    inside = anchor < A
    row = tl.load(rows + anchor, mask=inside, other=0)
    slot = tl.arange(0, KP)[None, :]
    real = inside[:, None] & (slot < K)
    at, own = anchor.to(tl.int64)[:, None] * K + slot, row[:, None] * K + slot
    d = tl.load(dst + at, mask=real, other=-1)
    drawn = d >= 0
    d_opacity = tl.load(d_opacities + d, mask=drawn, other=0.0)
    if RAW:
        d_opacity += tl.load(d_raw + at, mask=real, other=0.0)
    if TERMS:
        d_opacity -= tl.where(tl.load(raw + at, mask=real, other=0.0) < tau, hinge, 0.0)
    tl.store(d_opacity_head + at, d_opacity, mask=real)
    for c in tl.static_range(3):
        size = tl.exp(tl.load(log_scaling + row * 6 + c, mask=inside, other=0.0))
        bound = tl.exp(tl.load(log_scaling + row * 6 + 3 + c, mask=inside, other=0.0))
        d_offset = tl.load(d_means + d * 3 + c, mask=drawn, other=0.0) * size[:, None]
        tl.store(d_offsets + own * 3 + c, d_offset, mask=real)
        offset = tl.load(offsets + own * 3 + c, mask=drawn, other=0.0)
        tl.store(d_log_scaling + row * 6 + c, tl.sum(d_offset * offset, axis=1), mask=inside)
        part = activate(tl.load(cov + d * 7 + c, mask=drawn, other=0.0), 2)
        d_scale = tl.load(d_scales + d * 3 + c, mask=drawn, other=0.0)
        if TERMS:
            side = tl.load(scales + d * 3 + (c + 1) % 3, mask=drawn, other=0.0)
            d_scale += volume * side * tl.load(scales + d * 3 + (c + 2) % 3, mask=drawn, other=0.0)
        d_log = d_scale * bound[:, None] * part
        tl.store(d_log_scaling + row * 6 + 3 + c, tl.sum(d_log, axis=1), mask=inside)
        tl.store(d_cov + d * 7 + c, d_log * (1.0 - part), mask=drawn)
    write_unit_backward(cov + d * 7 + 3, quats + d * 4, d_quats + d * 4, d_cov + d * 7 + 3, drawn)
