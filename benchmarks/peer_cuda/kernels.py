# pyright: basic, reportMissingImports=false
"""The Triton kernels of L1 + SSIM and of Adam, as of commit da16e27."""

from __future__ import annotations

import triton
import triton.language as tl


@triton.jit
def blur(m, band, PRECISION: tl.constexpr):
    """Weighted means [T, T] of the windows around each pixel."""
    return tl.dot(band, tl.dot(m, band, input_precision=PRECISION), input_precision=PRECISION)


@triton.jit(do_not_specialize=["H", "W"])
def loss_forward(
    image, target, gradient, sums, H, W, l1_weight, dssim_weight,
    R: tl.constexpr, SCALE: tl.constexpr, NORM: tl.constexpr, C1: tl.constexpr, C2: tl.constexpr,
    T: tl.constexpr, WANTED: tl.constexpr, PRECISION: tl.constexpr,
):  # fmt: skip
    """Write this tile's part of both terms to `sums` [programs, 2] and, if WANTED, the gradient [H, W, 3] of 1 - SSIM.

    The weights include the division by the number of values. Window: exp(-SCALE t^2) / NORM for |t| <= R. Symbols as in
    `photometric.dissimilarity`: s and d are the sum (minus 1) and the difference of the images.
    """
    INNER: tl.constexpr = T - 4 * R
    place = tl.arange(0, T)
    row, column = tl.program_id(1) * INNER - 2 * R + place, tl.program_id(0) * INNER - 2 * R + place
    inside = ((row >= 0) & (row < H))[:, None] & ((column >= 0) & (column < W))[None, :]
    own = (place >= 2 * R) & (place < T - 2 * R)
    own = inside & own[:, None] & own[None, :]
    at = (row[:, None] * W + column[None, :]) * 3 + tl.program_id(2)
    x, y = tl.load(image + at, mask=inside, other=0.0), tl.load(target + at, mask=inside, other=0.0)
    s, d = x + y - 1.0, x - y
    t = (place[:, None] - place[None, :]).to(tl.float32)
    band = tl.where(tl.abs(t) <= R, tl.exp(-SCALE * t * t) / NORM, 0.0)

    ms, md = blur(s, band, PRECISION), blur(d, band, PRECISION)
    ss, dd = blur(s * s, band, PRECISION), blur(d * d, band, PRECISION)
    vd = dd - md * md
    u = ((ms + 1.0) * (ms + 1.0) + md * md) / 2 + C1
    v = (ss - ms * ms + vd) / 2 + C2
    p, q = md * md / u, vd / v
    program = (tl.program_id(2) * tl.num_programs(1) + tl.program_id(1)) * tl.num_programs(0) + tl.program_id(0)
    tl.store(sums + 2 * program, l1_weight * tl.sum(tl.sum(tl.where(own, tl.abs(d), 0.0), axis=1), axis=0))
    tl.store(sums + 2 * program + 1, dssim_weight * tl.sum(tl.sum(tl.where(own, p + q - p * q, 0.0), axis=1), axis=0))
    if WANTED:
        by_vd = (1.0 - p) * (1.0 - 0.5 * q) / v
        by_means = (1.0 - q) * ((2.0 - p) * md - p * (ms + 1.0)) / u + (1.0 - p) * q * ms / v - 2.0 * md * by_vd
        by_means, by_vd = tl.where(inside, by_means, 0.0), tl.where(inside, by_vd, 0.0)
        by_ss = tl.where(inside, -0.5 * (1.0 - p) * q / v, 0.0)
        out = blur(by_means, band, PRECISION) + 2.0 * (s * blur(by_ss, band, PRECISION) + d * blur(by_vd, band, PRECISION))
        tl.store(gradient + at, dssim_weight * out, mask=own)


@triton.jit(do_not_specialize=["count"])
def loss_backward(image, target, gradient, by_l1, by_dssim, out, count, l1_weight, B: tl.constexpr):
    """Write the gradient of the image: that of each term times the gradient of the loss in that term ([], on the device)."""
    at = tl.program_id(0) * B + tl.arange(0, B)
    inside = at < count
    d = tl.load(image + at, mask=inside, other=0.0) - tl.load(target + at, mask=inside, other=0.0)
    sign = tl.where(d > 0, 1.0, tl.where(d < 0, -1.0, 0.0))
    g = tl.load(gradient + at, mask=inside, other=0.0)
    tl.store(out + at, g * tl.load(by_dssim) + sign * (l1_weight * tl.load(by_l1)), mask=inside)


COLUMNS = tl.constexpr(10)


@triton.jit(do_not_specialize=["count"])
def adam_step(table, count, beta1, beta2, eps, B: tl.constexpr):
    """Update B values of the tensor that this program belongs to.

    `table` [count, 10] int64 has one row per tensor: the addresses of value, gradient, first and second moment and rows (0: all rows),
    the number of values and of values per row, the first program, and the bits of two float64 numbers: the step size, and the root of
    the second bias correction.
    """
    program, mine = tl.program_id(0), 0
    for i in range(count):
        mine = tl.where(program >= tl.load(table + i * COLUMNS + 7), i, mine)
    own = table + mine * COLUMNS
    value, gradient = tl.load(own).to(tl.pointer_type(tl.float32)), tl.load(own + 1).to(tl.pointer_type(tl.float32))
    first, second = tl.load(own + 2).to(tl.pointer_type(tl.float32)), tl.load(own + 3).to(tl.pointer_type(tl.float32))
    address, size, width = tl.load(own + 4), tl.load(own + 5), tl.load(own + 6)
    step_size = tl.load(own + 8).to(tl.float64, bitcast=True).to(tl.float32)
    root = tl.load(own + 9).to(tl.float64, bitcast=True).to(tl.float32)
    at = (program - tl.load(own + 7)) * B + tl.arange(0, B)
    inside = at < size
    rows = address.to(tl.pointer_type(tl.int64))
    row = tl.load(rows + at // width, mask=inside & (address != 0), other=0)
    at = tl.where(address != 0, row * width + at % width, at)
    g = tl.load(gradient + at, mask=inside, other=0.0)
    m, v = tl.load(first + at, mask=inside, other=0.0), tl.load(second + at, mask=inside, other=0.0)
    m = m + (g - m) * (1.0 - beta1)
    v = v * beta2 + (1.0 - beta2) * g * g
    p = tl.load(value + at, mask=inside, other=0.0)
    tl.store(first + at, m, mask=inside)
    tl.store(second + at, v, mask=inside)
    tl.store(value + at, p - step_size * (m / (tl.sqrt_rn(v) / root + eps)), mask=inside)
