# pyright: basic, reportMissingImports=false
"""Triton kernels that decode explicit Gaussians on CUDA, and back; `gaussians_direct.py` launches
them. `GaussianScene.decode` is the same in plain torch. A program handles B Gaussians. Each row
occurs once, so no sum uses atomics."""

from __future__ import annotations

import triton
import triton.language as tl

from scene_experts.geometry import sh
from scene_experts.geometry.triton_rotation import write_unit, write_unit_backward

EPS = tl.constexpr(1e-12)  # equals that of gaussians.py
C0, C1 = tl.constexpr(sh.C0), tl.constexpr(sh.C1)
C20, C21, C22, C23, C24 = (tl.constexpr(c) for c in sh.C2)
C30, C31, C32, C33, C34, C35, C36 = (tl.constexpr(c) for c in sh.C3)


@triton.jit
def harmonic(x, y, z, I: tl.constexpr):
    """Value of harmonic I at a unit direction, and its derivatives by x, y and z, as of a
    polynomial; see `geometry.sh.basis`."""
    nothing = x * 0.0
    if I == 0:
        return nothing + C0, nothing, nothing, nothing
    if I == 1:
        return -C1 * y, nothing, nothing - C1, nothing
    if I == 2:
        return C1 * z, nothing, nothing, nothing + C1
    if I == 3:
        return -C1 * x, nothing - C1, nothing, nothing
    if I == 4:
        return C20 * x * y, C20 * y, C20 * x, nothing
    if I == 5:
        return C21 * y * z, nothing, C21 * z, C21 * y
    if I == 6:
        return C22 * (2.0 * z * z - x * x - y * y), -2.0 * C22 * x, -2.0 * C22 * y, 4.0 * C22 * z
    if I == 7:
        return C23 * x * z, C23 * z, nothing, C23 * x
    if I == 8:
        return C24 * (x * x - y * y), 2.0 * C24 * x, -2.0 * C24 * y, nothing
    if I == 9:
        return C30 * y * (3.0 * x * x - y * y), 6.0 * C30 * x * y, 3.0 * C30 * (x * x - y * y), nothing
    if I == 10:
        return C31 * x * y * z, C31 * y * z, C31 * x * z, C31 * x * y
    if I == 11:
        value = C32 * y * (4.0 * z * z - x * x - y * y)
        return value, -2.0 * C32 * x * y, C32 * (4.0 * z * z - x * x - 3.0 * y * y), 8.0 * C32 * y * z
    if I == 12:
        value = C33 * z * (2.0 * z * z - 3.0 * x * x - 3.0 * y * y)
        return value, -6.0 * C33 * x * z, -6.0 * C33 * y * z, C33 * (6.0 * z * z - 3.0 * x * x - 3.0 * y * y)
    if I == 13:
        value = C34 * x * (4.0 * z * z - x * x - y * y)
        return value, C34 * (4.0 * z * z - 3.0 * x * x - y * y), -2.0 * C34 * x * y, 8.0 * C34 * x * z
    if I == 14:
        return C35 * z * (x * x - y * y), 2.0 * C35 * x * z, -2.0 * C35 * y * z, C35 * (x * x - y * y)
    return C36 * x * (x * x - 3.0 * y * y), 3.0 * C36 * (x * x - y * y), -6.0 * C36 * x * y, nothing


@triton.jit
def look(means, camera, row, inside):
    """Unit direction from the camera to each Gaussian, and the distance, at least EPS."""
    x = tl.load(means + row * 3, mask=inside, other=0.0) - tl.load(camera)
    y = tl.load(means + row * 3 + 1, mask=inside, other=0.0) - tl.load(camera + 1)
    z = tl.load(means + row * 3 + 2, mask=inside, other=1.0) - tl.load(camera + 2)
    length = tl.maximum(tl.sqrt_rn(x * x + y * y + z * z), EPS)
    return x / length, y / length, z / length, length


@triton.jit(do_not_specialize=["A"])
def decode(
    rows, means, log_scales, quats, raw, dc, rest, camera, out_means, out_quats, out_scales, out_opacities, out_colors, A,
    REST: tl.constexpr, COUNT: tl.constexpr, B: tl.constexpr,
):  # fmt: skip
    """Write the Gaussians of `rows` [A]. `rest` [N, REST, 3]; the first COUNT harmonics are used."""
    at = tl.program_id(0) * B + tl.arange(0, B)
    inside = at < A
    row = tl.load(rows + at, mask=inside, other=0)
    for c in tl.static_range(3):
        tl.store(out_means + at * 3 + c, tl.load(means + row * 3 + c, mask=inside, other=0.0), mask=inside)
        tl.store(out_scales + at * 3 + c, tl.exp(tl.load(log_scales + row * 3 + c, mask=inside, other=0.0)), mask=inside)
    write_unit(quats + row * 4, out_quats + at * 4, inside)
    o = tl.load(raw + row, mask=inside, other=0.0)
    tl.store(out_opacities + at, 1.0 / (1.0 + tl.exp(-o)), mask=inside)
    x, y, z, _ = look(means, camera, row, inside)
    r = C0 * tl.load(dc + row * 3, mask=inside, other=0.0)
    g = C0 * tl.load(dc + row * 3 + 1, mask=inside, other=0.0)
    b = C0 * tl.load(dc + row * 3 + 2, mask=inside, other=0.0)
    for i in tl.static_range(1, COUNT):
        value, _, _, _ = harmonic(x, y, z, i)
        own = rest + (row * REST + (i - 1)) * 3
        r += value * tl.load(own, mask=inside, other=0.0)
        g += value * tl.load(own + 1, mask=inside, other=0.0)
        b += value * tl.load(own + 2, mask=inside, other=0.0)
    tl.store(out_colors + at * 3, tl.maximum(r + 0.5, 0.0), mask=inside)
    tl.store(out_colors + at * 3 + 1, tl.maximum(g + 0.5, 0.0), mask=inside)
    tl.store(out_colors + at * 3 + 2, tl.maximum(b + 0.5, 0.0), mask=inside)


@triton.jit(do_not_specialize=["A"])
def backward(
    rows, means, quats, rest, camera, unit_quats, scales, opacities, colors, by_means, by_quats, by_scales, by_opacities, by_colors,
    d_means, d_log_scales, d_quats, d_raw, d_dc, d_rest, A, volume,
    REST: tl.constexpr, COUNT: tl.constexpr, B: tl.constexpr,
):  # fmt: skip
    """Write the gradients of the columns at `rows` [A] from those of the Gaussians, and of `volume`
    times the sum of their volumes."""
    at = tl.program_id(0) * B + tl.arange(0, B)
    inside = at < A
    row = tl.load(rows + at, mask=inside, other=0)
    for c in tl.static_range(3):
        s = tl.load(scales + at * 3 + c, mask=inside, other=0.0)
        side = tl.load(scales + at * 3 + (c + 1) % 3, mask=inside, other=0.0)
        d = tl.load(by_scales + at * 3 + c, mask=inside, other=0.0)
        d += volume * side * tl.load(scales + at * 3 + (c + 2) % 3, mask=inside, other=0.0)
        tl.store(d_log_scales + row * 3 + c, d * s, mask=inside)
    write_unit_backward(quats + row * 4, unit_quats + at * 4, by_quats + at * 4, d_quats + row * 4, inside)
    o = tl.load(opacities + at, mask=inside, other=0.0)
    tl.store(d_raw + row, tl.load(by_opacities + at, mask=inside, other=0.0) * o * (1.0 - o), mask=inside)
    x, y, z, distance = look(means, camera, row, inside)
    r = tl.where(tl.load(colors + at * 3, mask=inside, other=0.0) > 0, tl.load(by_colors + at * 3, mask=inside, other=0.0), 0.0)
    g = tl.where(tl.load(colors + at * 3 + 1, mask=inside, other=0.0) > 0, tl.load(by_colors + at * 3 + 1, mask=inside, other=0.0), 0.0)
    b = tl.where(tl.load(colors + at * 3 + 2, mask=inside, other=0.0) > 0, tl.load(by_colors + at * 3 + 2, mask=inside, other=0.0), 0.0)
    tl.store(d_dc + row * 3, C0 * r, mask=inside)
    tl.store(d_dc + row * 3 + 1, C0 * g, mask=inside)
    tl.store(d_dc + row * 3 + 2, C0 * b, mask=inside)
    dx, dy, dz = x * 0.0, x * 0.0, x * 0.0
    for i in tl.static_range(1, COUNT):
        value, vx, vy, vz = harmonic(x, y, z, i)
        own, to = rest + (row * REST + (i - 1)) * 3, d_rest + (row * REST + (i - 1)) * 3
        up = r * tl.load(own, mask=inside, other=0.0)
        up += g * tl.load(own + 1, mask=inside, other=0.0) + b * tl.load(own + 2, mask=inside, other=0.0)
        dx += up * vx
        dy += up * vy
        dz += up * vz
        tl.store(to, value * r, mask=inside)
        tl.store(to + 1, value * g, mask=inside)
        tl.store(to + 2, value * b, mask=inside)
    forward = dx * x + dy * y + dz * z  # a direction has length 1
    tl.store(d_means + row * 3, tl.load(by_means + at * 3, mask=inside, other=0.0) + (dx - forward * x) / distance, mask=inside)
    tl.store(d_means + row * 3 + 1, tl.load(by_means + at * 3 + 1, mask=inside, other=0.0) + (dy - forward * y) / distance, mask=inside)
    tl.store(d_means + row * 3 + 2, tl.load(by_means + at * 3 + 2, mask=inside, other=0.0) + (dz - forward * z) / distance, mask=inside)
