# pyright: basic, reportMissingImports=false
"""Triton kernel of the 3 sigma radii; `project_cuda.py` launches it. `reference.project` is the
same in plain torch."""

from __future__ import annotations

import triton
import triton.language as tl


@triton.jit
def row_of(view, i: tl.constexpr, x, y, z):
    """Product of row i of the rotation in `view` [4, 4] with (x, y, z)."""
    return tl.load(view + 4 * i) * x + tl.load(view + 4 * i + 1) * y + tl.load(view + 4 * i + 2) * z


@triton.jit(do_not_specialize=["M"])
def radii(
    means, quats, scales, view, out, extents, M, near, fx, fy, cx, cy, left, right, top, bottom, width, height,
    BLUR: tl.constexpr, ROTATED: tl.constexpr, MASKED: tl.constexpr, B: tl.constexpr,
):  # fmt: skip
    """Write the radii [M] int32 in px, 0 for Gaussians that are not drawn; if MASKED, also 0 to the
    rows of `extents` [M, 2] of these.

    `left` to `bottom` bound x / z and y / z in the Jacobian; `width` and `height` are those of all
    16 px tiles of the picture.
    """
    at = tl.program_id(0) * B + tl.arange(0, B)
    inside = at < M
    x, y = tl.load(means + at * 3, mask=inside, other=0.0), tl.load(means + at * 3 + 1, mask=inside, other=0.0)
    z = tl.load(means + at * 3 + 2, mask=inside, other=0.0)
    px, py = row_of(view, 0, x, y, z) + tl.load(view + 3), row_of(view, 1, x, y, z) + tl.load(view + 7)
    pz = row_of(view, 2, x, y, z) + tl.load(view + 11)
    front = pz > near
    px, py, pz = tl.where(front, px, 0.0), tl.where(front, py, 0.0), tl.where(front, pz, 1.0)
    u, v = fx * px / pz + cx, fy * py / pz + cy
    tx, ty = tl.minimum(tl.maximum(px / pz, left), right), tl.minimum(tl.maximum(py / pz, top), bottom)

    xx, xy, yy = tl.zeros((B,), tl.float32), tl.zeros((B,), tl.float32), tl.zeros((B,), tl.float32)
    qw, qx, qy, qz = tl.full((B,), 1.0, tl.float32), xx, xx, xx
    if ROTATED:
        qw, qx = tl.load(quats + at * 4, mask=inside, other=1.0), tl.load(quats + at * 4 + 1, mask=inside, other=0.0)
        qy, qz = tl.load(quats + at * 4 + 2, mask=inside, other=0.0), tl.load(quats + at * 4 + 3, mask=inside, other=0.0)
    for axis in tl.static_range(3):
        size = tl.load(scales + at * 3 + axis, mask=inside, other=1.0)
        if ROTATED:  # column `axis` of the rotation matrix
            if axis == 0:
                ax, ay, az = 1.0 - 2.0 * (qy * qy + qz * qz), 2.0 * (qx * qy + qw * qz), 2.0 * (qx * qz - qw * qy)
            elif axis == 1:
                ax, ay, az = 2.0 * (qx * qy - qw * qz), 1.0 - 2.0 * (qx * qx + qz * qz), 2.0 * (qy * qz + qw * qx)
            else:
                ax, ay, az = 2.0 * (qx * qz + qw * qy), 2.0 * (qy * qz - qw * qx), 1.0 - 2.0 * (qx * qx + qy * qy)
            ax, ay, az = ax * size, ay * size, az * size
        else:
            ax, ay, az = size * (axis == 0), size * (axis == 1), size * (axis == 2)
        vx, vy, vz = row_of(view, 0, ax, ay, az), row_of(view, 1, ax, ay, az), row_of(view, 2, ax, ay, az)
        wx, wy = fx * (vx - tx * vz) / pz, fy * (vy - ty * vz) / pz
        xx += wx * wx
        xy += wx * wy
        yy += wy * wy
    xx, yy = xx + BLUR, yy + BLUR
    det = xx * yy - xy * xy
    drawn = front & (det > 0)
    det = tl.where(drawn, det, 1.0)
    mid = (xx + yy) / 2
    radius = tl.ceil(3.0 * tl.sqrt_rn(mid + tl.sqrt_rn(tl.maximum(mid * mid - det, 0.1))))
    drawn = drawn & (u + radius > 0) & (u - radius < width) & (v + radius > 0) & (v - radius < height) & (radius < float("inf"))
    radius = tl.where(drawn, tl.minimum(radius, 1073741824.0), 0.0).to(tl.int32)
    tl.store(out + at, radius, mask=inside)
    if MASKED:
        hidden = inside & (radius == 0)
        tl.store(extents + at * 2, radius, mask=hidden)
        tl.store(extents + at * 2 + 1, radius, mask=hidden)
