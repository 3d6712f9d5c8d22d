# pyright: basic, reportMissingImports=false
"""Triton kernels of the graph points; `fused.py` launches them. `hash_grid.py` and `network.py` are
the same in plain torch.

A program of the hash grid processes B points of one level; one of the graph, B points and all F
channels. FP and CP are F and C padded to powers of two. Rows of `inputs` and of its gradient have
WIDTH values: L * C of the grid, F of the graph, and if VIEW, 4 of the direction and the distance.

No sum of the graph uses atomics: a point reads the list of the points that have it as a neighbour.
The gradient of the grid uses atomics on integers, whose sums do not depend on the order. So the
results are the same bits in every run.
"""

from __future__ import annotations

import triton
import triton.language as tl

from scene_experts.geometry.triton_rotation import write_unit, write_unit_backward

EPS = tl.constexpr(1e-12)  # equals EPS of scene.py


@triton.jit
def split_axis(xyz, at, inside, axis: tl.constexpr, low, edge, cells):
    """Lower corner [B] int64 of the cells around points on one axis, and the weight of the upper
    corner."""
    unit = tl.div_rn(tl.load(xyz + at * 3 + axis, mask=inside, other=0.0) - low, edge)
    place = tl.minimum(tl.maximum(unit, 0.0), 1.0) * cells.to(tl.float32)
    below = tl.floor(place)
    return below.to(tl.int64), place - below


@triton.jit
def level_of(levels, level):
    """First table row, number of rows, cells per axis and whether each corner has its own row."""
    return tl.load(levels + level * 4), tl.load(levels + level * 4 + 1), tl.load(levels + level * 4 + 2), tl.load(levels + level * 4 + 3)


@triton.jit
def corner_of(i: tl.constexpr, x, y, z, wx, wy, wz, rows, cells, dense):
    """Row of the level's table and weight [B] of corner i (0 to 7; z changes fastest)."""
    DX: tl.constexpr = i // 4
    DY: tl.constexpr = i // 2 % 2
    DZ: tl.constexpr = i % 2
    x, y, z = x + DX, y + DY, z + DZ
    if dense != 0:
        row = x + (cells + 1) * (y + (cells + 1) * z)
        row = tl.where(row >= rows, row - rows, row)  # a corner outside the cube, with the weight 0
    else:
        row = (x ^ (y * 2654435761) ^ (z * 805459861)) & (rows - 1)
    wx = wx if DX else 1.0 - wx
    wy = wy if DY else 1.0 - wy
    wz = wz if DZ else 1.0 - wz
    return row, wx * wy * wz


@triton.jit(do_not_specialize=["A"])
def grid_forward(
    xyz, points, levels, table, inputs, A, low_x, low_y, low_z, edge,
    L: tl.constexpr, C: tl.constexpr, WIDTH: tl.constexpr, B: tl.constexpr, CP: tl.constexpr,
):  # fmt: skip
    """Write the features of the points `points` [A] of one level of the hash grid to `inputs`
    [A, WIDTH]."""
    me = tl.program_id(0).to(tl.int64) * B + tl.arange(0, B)
    inside, level, channel = me < A, tl.program_id(1), tl.arange(0, CP)[None, :]
    at = tl.load(points + me, mask=inside, other=0)
    first, rows, cells, dense = level_of(levels, level)
    x, wx = split_axis(xyz, at, inside, 0, low_x, edge, cells)
    y, wy = split_axis(xyz, at, inside, 1, low_y, edge, cells)
    z, wz = split_axis(xyz, at, inside, 2, low_z, edge, cells)
    there = inside[:, None] & (channel < C)
    total = tl.zeros((B, CP), tl.float32)
    for i in tl.static_range(8):
        row, weight = corner_of(i, x, y, z, wx, wy, wz, rows, cells, dense)
        total += weight[:, None] * tl.load(table + (first + row)[:, None] * C + channel, mask=there, other=0.0)
    tl.store(inputs + me[:, None] * WIDTH + level * C + channel, total, mask=there)


@triton.jit(do_not_specialize=["A"])
def grid_backward(
    xyz, points, levels, d_inputs, peak, sums, A, low_x, low_y, low_z, edge, scale,
    L: tl.constexpr, C: tl.constexpr, WIDTH: tl.constexpr, B: tl.constexpr, CP: tl.constexpr,
):  # fmt: skip
    """Add the gradients of the table, as integers, to `sums` [rows, C] int64.

    The unit of the integers is peak / scale. No gradient of `d_inputs` exceeds peak [1], and A
    times `scale` is at most 2^62.
    """
    me = tl.program_id(0).to(tl.int64) * B + tl.arange(0, B)
    inside, level, channel = me < A, tl.program_id(1), tl.arange(0, CP)[None, :]
    at = tl.load(points + me, mask=inside, other=0)
    first, rows, cells, dense = level_of(levels, level)
    x, wx = split_axis(xyz, at, inside, 0, low_x, edge, cells)
    y, wy = split_axis(xyz, at, inside, 1, low_y, edge, cells)
    z, wz = split_axis(xyz, at, inside, 2, low_z, edge, cells)
    there = inside[:, None] & (channel < C)
    most = tl.load(peak)
    part = tl.load(d_inputs + me[:, None] * WIDTH + level * C + channel, mask=there, other=0.0) / tl.where(most > 0, most, 1.0)
    for i in tl.static_range(8):
        row, weight = corner_of(i, x, y, z, wx, wy, wz, rows, cells, dense)
        share = (part * weight[:, None] * scale).to(tl.int64)
        tl.atomic_add(sums + (first + row)[:, None] * C + channel, share, mask=there & (share != 0), sem="relaxed")


@triton.jit(do_not_specialize=["M"])
def grid_gradient(sums, peak, out, M, scale, B: tl.constexpr):
    """Convert the sums [M] of `grid_backward` to gradients. All are NaN if `peak` is."""
    at = tl.program_id(0).to(tl.int64) * B + tl.arange(0, B)
    unit = tl.load(peak).to(tl.float64) / scale
    tl.store(out + at, (tl.load(sums + at, mask=at < M, other=0).to(tl.float64) * unit).to(tl.float32), mask=at < M)


@triton.jit
def lists_of(rows, start, A, B: tl.constexpr):
    """Points of a block: indices [B] int64, a mask, rows of the table, and where the lists of those
    that have them as neighbours begin and end."""
    me = tl.program_id(0).to(tl.int64) * B + tl.arange(0, B)
    inside = me < A
    row = tl.load(rows + me, mask=inside, other=0)
    return me, inside, row, tl.load(start + row, mask=inside, other=0), tl.load(start + row + 1, mask=inside, other=0)


@triton.jit(do_not_specialize=["A"])
def neighbour_minima(
    feature, rows, place, start, known, least, A,
    K: tl.constexpr, F: tl.constexpr, B: tl.constexpr, FP: tl.constexpr,
):  # fmt: skip
    """Write the minima `least` [A, F] of the features [A, F] over the visible points that have a
    point as a neighbour, and the point."""
    me, inside, _, begin, end = lists_of(rows, start, A, B)
    column = tl.arange(0, FP)[None, :]
    there = inside[:, None] & (column < F)
    low = tl.load(feature + me[:, None] * F + column, mask=there, other=0.0)
    for i in range(tl.max((end - begin).to(tl.int32), axis=0)):
        edge = tl.load(known + begin + i, mask=begin + i < end, other=0)
        other = tl.load(place + edge // K, mask=begin + i < end, other=-1).to(tl.int64)
        seen = there & (other >= 0)[:, None]
        low = tl.minimum(low, tl.load(feature + other[:, None] * F + column, mask=seen, other=float("inf")))
    tl.store(least + me[:, None] * F + column, low, mask=there)


@triton.jit(do_not_specialize=["A"])
def blend_forward(
    feature, least, rows, place, index, closeness, xyz, camera, inputs, totals, A, share,
    K: tl.constexpr, F: tl.constexpr, VIEW: tl.constexpr, WIDTH: tl.constexpr, B: tl.constexpr, FP: tl.constexpr,
):  # fmt: skip
    """Write the blended features, and if VIEW, directions and distances, to the last columns of
    `inputs` [A, WIDTH].

    Also writes `totals` [A]: the sum of the closeness of the visible neighbours times their number,
    by which their weights are divided.
    """
    me = tl.program_id(0).to(tl.int64) * B + tl.arange(0, B)
    inside, column = me < A, tl.arange(0, FP)[None, :]
    row = tl.load(rows + me, mask=inside, other=0)
    there = inside[:, None] & (column < F)
    blended, count, total = tl.zeros((B, FP), tl.float32), tl.zeros((B,), tl.float32), tl.zeros((B,), tl.float32)
    for j in range(K):
        other = tl.load(place + tl.load(index + row * K + j, mask=inside, other=0), mask=inside, other=-1).to(tl.int64)
        seen = inside & (other >= 0)
        close = tl.load(closeness + row * K + j, mask=seen, other=0.0)
        count += tl.where(seen, 1.0, 0.0)
        total += close
        at = other[:, None] * F + column
        high = tl.load(feature + at, mask=there & seen[:, None], other=0.0)
        blended += close[:, None] * (high - tl.load(least + at, mask=there & seen[:, None], other=0.0))
    total = tl.maximum(total * count, 1.17549435e-38)
    own = tl.load(feature + me[:, None] * F + column, mask=there, other=0.0)
    first: tl.constexpr = WIDTH - F - 4 * VIEW
    tl.store(inputs + me[:, None] * WIDTH + first + column, own + share * blended / total[:, None], mask=there)
    tl.store(totals + me, total, mask=inside)
    if VIEW:
        vx = tl.load(xyz + row * 3, mask=inside, other=0.0) - tl.load(camera)
        vy = tl.load(xyz + row * 3 + 1, mask=inside, other=0.0) - tl.load(camera + 1)
        vz = tl.load(xyz + row * 3 + 2, mask=inside, other=0.0) - tl.load(camera + 2)
        length = tl.sqrt_rn(vx * vx + vy * vy + vz * vz)
        near = tl.maximum(length, EPS)
        to = inputs + me * WIDTH + first + F
        tl.store(to, vx / near, mask=inside)
        tl.store(to + 1, vy / near, mask=inside)
        tl.store(to + 2, vz / near, mask=inside)
        tl.store(to + 3, length, mask=inside)


@triton.jit(do_not_specialize=["A"])
def minima_backward(
    feature, least, rows, place, start, known, closeness, totals, d_inputs, strongest, d_strongest, shared, d_feature, A, share,
    K: tl.constexpr, F: tl.constexpr, VIEW: tl.constexpr, WIDTH: tl.constexpr, B: tl.constexpr, FP: tl.constexpr,
):  # fmt: skip
    """Write the gradients of the maxima h to `shared` [A, F], each divided by the number of points
    that attain it, and to `d_feature` [N, F] all that does not pass through other points.

    d_strongest [F]: gradient of the maxima `strongest` [F], divided likewise.
    """
    me, inside, row, begin, end = lists_of(rows, start, A, B)
    column, first = tl.arange(0, FP)[None, :], WIDTH - F - 4 * VIEW
    there = inside[:, None] & (column < F)
    low = tl.load(least + me[:, None] * F + column, mask=there, other=0.0)
    grad, ties = tl.zeros((B, FP), tl.float32), tl.zeros((B, FP), tl.float32)
    for i in range(tl.max((end - begin).to(tl.int32), axis=0)):
        edge = tl.load(known + begin + i, mask=begin + i < end, other=0)
        other = tl.load(place + edge // K, mask=begin + i < end, other=-1).to(tl.int64)
        seen = other >= 0
        both = there & seen[:, None]
        weight = share * tl.load(closeness + edge, mask=seen, other=0.0) / tl.load(totals + other, mask=seen, other=1.0)
        grad += weight[:, None] * tl.load(d_inputs + other[:, None] * WIDTH + first + column, mask=both, other=0.0)
        held = tl.load(feature + other[:, None] * F + column, mask=both, other=0.0)
        ties += tl.where(both & (held == low), 1.0, 0.0)
    tl.store(shared + me[:, None] * F + column, grad / tl.maximum(ties, 1.0), mask=there)
    own = tl.load(feature + me[:, None] * F + column, mask=there, other=0.0)
    grad += tl.load(d_inputs + me[:, None] * WIDTH + first + column, mask=there, other=0.0)
    most = own == tl.load(strongest + column, mask=column < F, other=0.0)
    grad += tl.where(most, tl.load(d_strongest + column, mask=column < F, other=0.0), 0.0)
    tl.store(d_feature + row[:, None] * F + column, grad, mask=there)


@triton.jit(do_not_specialize=["A"])
def blend_backward(
    feature, least, rows, place, index, shared, d_feature, A,
    K: tl.constexpr, F: tl.constexpr, B: tl.constexpr, FP: tl.constexpr,
):  # fmt: skip
    """Subtract from `d_feature` [N, F] the gradients of the minima that a point attains, its own
    and those of its neighbours."""
    me = tl.program_id(0).to(tl.int64) * B + tl.arange(0, B)
    inside, column = me < A, tl.arange(0, FP)[None, :]
    row = tl.load(rows + me, mask=inside, other=0)
    there = inside[:, None] & (column < F)
    own = tl.load(feature + me[:, None] * F + column, mask=there, other=0.0)
    taken = tl.zeros((B, FP), tl.float32)
    for j in range(K):
        other = tl.load(place + tl.load(index + row * K + j, mask=inside, other=0), mask=inside, other=-1).to(tl.int64)
        both = there & (other >= 0)[:, None]
        at = other[:, None] * F + column
        hit = both & (own == tl.load(least + at, mask=both, other=0.0))
        taken += tl.load(shared + at, mask=hit, other=0.0)
    to = d_feature + row[:, None] * F + column
    tl.store(to, tl.load(to, mask=there, other=0.0) - taken, mask=there)


@triton.jit
def affine_of(alpha, beta, strongest, column, WIDTH: tl.constexpr, F: tl.constexpr):
    """Factor, summand and shared feature of the input columns, and a mask of the shared columns."""
    shared = (column >= WIDTH - F) & (column < WIDTH)
    a = tl.load(alpha + column, mask=column < WIDTH, other=1.0)
    b = tl.load(beta + column, mask=column < WIDTH, other=0.0)
    return a, b, tl.load(strongest + column - (WIDTH - F), mask=shared, other=0.0), shared


@triton.jit
def fold_forward(
    weight, alpha, beta, strongest, out, bias,
    IN: tl.constexpr, OUT: tl.constexpr, WIDTH: tl.constexpr, F: tl.constexpr, CP: tl.constexpr,
):  # fmt: skip
    """Fold the affine layer and the shared features into a row of `weight` [H, IN]; to `out`
    [H, OUT] and `bias` [H].

    Columns of `weight`: own features, F shared ones (they end at WIDTH), the view. `out` lacks the
    shared ones; if it has more columns than remain, they are 0.
    """
    h, column = tl.program_id(0), tl.arange(0, CP)
    w = tl.load(weight + h * IN + column, mask=column < IN, other=0.0)
    a, b, s, shared = affine_of(alpha, beta, strongest, column, WIDTH, F)
    tl.store(bias + h, tl.sum(w * a * s + w * b, axis=0))
    to = tl.where(column < WIDTH, column, column - F)
    tl.store(out + h * OUT + to, w * a, mask=(column < OUT + F) & (shared == 0))


@triton.jit
def fold_backward(
    weight, alpha, beta, strongest, d_out, d_bias, d_weight, d_alpha, d_beta, d_strongest,
    H: tl.constexpr, IN: tl.constexpr, OUT: tl.constexpr, WIDTH: tl.constexpr, F: tl.constexpr, B: tl.constexpr, HB: tl.constexpr,
):  # fmt: skip
    """Gradients of what `fold_forward` reads, for B columns."""
    column = tl.program_id(0) * B + tl.arange(0, B)
    a, b, s, shared = affine_of(alpha, beta, strongest, column, WIDTH, F)
    to = tl.where(column < WIDTH, column, column - F)
    sum_a, sum_b, sum_s = tl.zeros((B,), tl.float32), tl.zeros((B,), tl.float32), tl.zeros((B,), tl.float32)
    for first in range(0, H, HB):
        h = first + tl.arange(0, HB)
        there = (h < H)[:, None] & (column < IN)[None, :]
        w = tl.load(weight + h[:, None] * IN + column[None, :], mask=there, other=0.0)
        up = tl.load(d_bias + h, mask=h < H, other=0.0)[:, None]
        own = there & (shared == 0)[None, :]
        part = tl.load(d_out + h[:, None] * OUT + to[None, :], mask=own, other=0.0) + up * s[None, :]
        tl.store(d_weight + h[:, None] * IN + column[None, :], part * a[None, :] + up * b[None, :], mask=there)
        sum_a += tl.sum(part * w, axis=0)
        sum_b += tl.sum(up * w, axis=0)
        sum_s += tl.sum(up * w * a[None, :], axis=0)
    tl.store(d_alpha + column, sum_a, mask=column < WIDTH)
    tl.store(d_beta + column, sum_b, mask=column < WIDTH)
    tl.store(d_strongest + column - (WIDTH - F), sum_s, mask=shared)


@triton.jit
def sigmoid(y):
    return 1.0 / (1.0 + tl.exp(-y))


@triton.jit(do_not_specialize=["M"])
def place_points(
    keep, source, xyz, log_scaling, offset, shape, color, raw, means, quats, scales, opacities, colors, M, B: tl.constexpr,
):  # fmt: skip
    """Write the M drawn Gaussians, as `GraphScene.place`."""
    at = tl.program_id(0).to(tl.int64) * B + tl.arange(0, B)
    inside = at < M
    row = tl.load(source + at, mask=inside, other=0)
    tl.store(opacities + at, tl.load(raw + tl.load(keep + at, mask=inside, other=0), mask=inside, other=0.0), mask=inside)
    for c in tl.static_range(3):
        size = tl.exp(tl.load(log_scaling + row * 6 + c, mask=inside, other=0.0))
        bound = tl.exp(tl.load(log_scaling + row * 6 + 3 + c, mask=inside, other=0.0))
        mean = tl.load(xyz + row * 3 + c, mask=inside, other=0.0) + tl.load(offset + at * 3 + c, mask=inside, other=0.0) * size
        tl.store(means + at * 3 + c, mean, mask=inside)
        tl.store(scales + at * 3 + c, bound * sigmoid(tl.load(shape + at * 7 + c, mask=inside, other=0.0)), mask=inside)
        tl.store(colors + at * 3 + c, sigmoid(tl.load(color + at * 3 + c, mask=inside, other=0.0)), mask=inside)
    write_unit(shape + at * 7 + 3, quats + at * 4, inside)


@triton.jit(do_not_specialize=["M"])
def place_points_backward(
    keep, source, log_scaling, offset, shape, quats, colors, d_means, d_quats, d_scales, d_opacities, d_colors,
    d_log_scaling, d_offset, d_shape, d_color, d_raw, M, B: tl.constexpr,
):  # fmt: skip
    """Gradients of what `place_points` reads. Those of rows and points that are not drawn are left
    as they are."""
    at = tl.program_id(0).to(tl.int64) * B + tl.arange(0, B)
    inside = at < M
    row = tl.load(source + at, mask=inside, other=0)
    tl.store(d_raw + tl.load(keep + at, mask=inside, other=0), tl.load(d_opacities + at, mask=inside, other=0.0), mask=inside)
    for c in tl.static_range(3):
        size = tl.exp(tl.load(log_scaling + row * 6 + c, mask=inside, other=0.0))
        bound = tl.exp(tl.load(log_scaling + row * 6 + 3 + c, mask=inside, other=0.0))
        moved = tl.load(d_means + at * 3 + c, mask=inside, other=0.0) * size
        tl.store(d_offset + at * 3 + c, moved, mask=inside)
        tl.store(d_log_scaling + row * 6 + c, moved * tl.load(offset + at * 3 + c, mask=inside, other=0.0), mask=inside)
        part = sigmoid(tl.load(shape + at * 7 + c, mask=inside, other=0.0))
        grown = tl.load(d_scales + at * 3 + c, mask=inside, other=0.0) * bound * part
        tl.store(d_log_scaling + row * 6 + 3 + c, grown, mask=inside)
        tl.store(d_shape + at * 7 + c, grown * (1.0 - part), mask=inside)
        value = tl.load(colors + at * 3 + c, mask=inside, other=0.0)
        tl.store(d_color + at * 3 + c, tl.load(d_colors + at * 3 + c, mask=inside, other=0.0) * value * (1.0 - value), mask=inside)
    write_unit_backward(shape + at * 7 + 3, quats + at * 4, d_quats + at * 4, d_shape + at * 7 + 3, inside)
