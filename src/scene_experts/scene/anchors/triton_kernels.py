# pyright: basic, reportMissingImports=false
"""Triton kernels of the CUDA decode; `triton_decode` calls them. This file alone imports triton.

Each program processes a block of B anchors. The anchors are sorted by their set of chosen experts.
Most blocks therefore evaluate only k experts, and the program mixes their outputs in registers. No
sum uses atomics, so the results are the same bits in every run.

Tiles are padded to powers of two: XP inputs, HP hidden units, COLS outputs, EP experts, KP slots.
The input of a network is x = (feature, unit direction, distance if used, 1). The 1 multiplies the
bias, so one matrix product computes the first layer and one its gradient. Activations: TANH, NONE,
SIGMOID. `dst` [A * K] is the index of each slot among the drawn Gaussians, or -1 if the slot is not
drawn.

Triton compiles a kernel anew for a count that is 1 or divisible by 16, unless `do_not_specialize`
names it. The counts change in every step.
"""

from __future__ import annotations

import triton
import triton.language as tl

TANH, NONE, SIGMOID = 0, 1, 2
EPS = tl.constexpr(1e-12)  # keeps directions and quaternions finite if their length is 0; equals EPS of scene.py


@triton.jit
def activate(y, ACT: tl.constexpr):
    """Activation of the last layer. Near 0, tanh is a polynomial fitted on [0, 0.625] with a
    relative error of 8e-8."""
    if ACT == 0:
        z = y * y
        small = y + y * z * (-0.3333328 + z * (0.13331442 + z * (-0.05373971 + z * (0.020639075 - 0.0057049743 * z))))
        large = 1.0 - 2.0 / (tl.exp(2.0 * tl.abs(y)) + 1.0)
        y = tl.where(tl.abs(y) < 0.625, small, tl.where(y < 0, -large, large))
    if ACT == 2:
        y = 1.0 / (1.0 + tl.exp(-y))
    return y


@triton.jit
def slope(a, ACT: tl.constexpr):
    """Derivative of the activation, computed from its value `a`."""
    if ACT == 0:
        return 1.0 - a * a
    if ACT == 2:
        return a * (1.0 - a)
    return a * 0.0 + 1.0


@triton.jit
def inputs(feature, xyz, camera, row, mine, F: tl.constexpr, DISTANCE: tl.constexpr, XP: tl.constexpr):
    """Inputs x [B, XP] of the anchors in rows `row` [B] of the table. Rows outside the mask `mine`
    [B] are 0: NaN there does not spread."""
    column = tl.arange(0, XP)[None, :]
    x = tl.load(feature + row[:, None] * F + column, mask=mine[:, None] & (column < F), other=0.0)
    vx = tl.load(xyz + row * 3, mask=mine, other=0.0) - tl.load(camera)
    vy = tl.load(xyz + row * 3 + 1, mask=mine, other=0.0) - tl.load(camera + 1)
    vz = tl.load(xyz + row * 3 + 2, mask=mine, other=0.0) - tl.load(camera + 2)
    length = tl.sqrt_rn(vx * vx + vy * vy + vz * vz)
    near = tl.maximum(length, EPS)
    x = tl.where(column == F, (vx / near)[:, None], x)
    x = tl.where(column == F + 1, (vy / near)[:, None], x)
    x = tl.where(column == F + 2, (vz / near)[:, None], x)
    if DISTANCE:
        x = tl.where(column == F + 3, length[:, None], x)
    x = tl.where(column == F + 3 + DISTANCE, 1.0, x)
    return tl.where(mine[:, None], x, 0.0)


@triton.jit
def first_layer(w1, b1, e, H: tl.constexpr, D: tl.constexpr, HP: tl.constexpr, XP: tl.constexpr):
    """Weights [XP, HP] of the first layer of expert e. Row D is the bias."""
    column, unit = tl.arange(0, XP)[:, None], tl.arange(0, HP)[None, :]
    w = tl.load(w1 + (e * H + unit) * D + column, mask=(column < D) & (unit < H), other=0.0)
    b = tl.load(b1 + e * H + unit, mask=unit < H, other=0.0)
    return tl.where(column == D, b, w)


@triton.jit
def second_layer(w2, b2, e, H: tl.constexpr, OUT: tl.constexpr, HP: tl.constexpr, COLS: tl.constexpr):
    """Weights [HP, COLS] and bias [COLS] of the second layer of expert e."""
    unit, column = tl.arange(0, HP)[:, None], tl.arange(0, COLS)
    w = tl.load(w2 + (e * OUT + column[None, :]) * H + unit, mask=(unit < H) & (column[None, :] < OUT), other=0.0)
    return w, tl.load(b2 + e * OUT + column, mask=column < OUT, other=0.0)


@triton.jit
def relu(z):
    return tl.where(z < 0, 0.0, z)  # maximum would replace NaN by 0


@triton.jit
def members(key, inside, e, SPARSE: tl.constexpr):
    """Mask [B] of the anchors in the block that expert e decodes. Bit e of `key` [B] is set if
    expert e is chosen."""
    if SPARSE:
        inside = inside & (((key >> e) & 1) == 1)
    return inside


@triton.jit
def block_of(order, keys, rows, block, A, B: tl.constexpr, SPARSE: tl.constexpr):
    """Anchors of a block: indices into `rows`, rows of the table, keys, and a mask of those that
    exist, [B] each."""
    place = block * B + tl.arange(0, B)
    inside = place < A
    anchor, key = place.to(tl.int64), place
    if SPARSE:
        anchor = tl.load(order + place, mask=inside, other=0)
        key = tl.load(keys + anchor, mask=inside, other=0)
    return anchor, tl.load(rows + anchor, mask=inside, other=0), key, inside


@triton.jit
def outputs(dst, anchor, inside, K: tl.constexpr, C: tl.constexpr, COLS: tl.constexpr, COMPACT: tl.constexpr):
    """Addresses [B, COLS] of the K * C outputs of each anchor, and a mask. COMPACT: drawn Gaussians
    only, otherwise all slots."""
    column = tl.arange(0, COLS)[None, :]
    there = inside[:, None] & (column < K * C)
    at = anchor[:, None] * (K * C) + column
    if COMPACT:
        d = tl.load(dst + anchor[:, None] * K + column // C, mask=there, other=-1).to(tl.int64)
        at, there = d * C + column % C, there & (d >= 0)
    return at, there


@triton.jit(do_not_specialize=["A"])
def route(
    rows, xyz, feature, router_w, router_b, gates, weight, chosen, keys, A, extent,
    F: tl.constexpr, E: tl.constexpr, TOP: tl.constexpr, BIAS: tl.constexpr, POSITION: tl.constexpr,
    B: tl.constexpr, FP: tl.constexpr, EP: tl.constexpr, PRECISION: tl.constexpr,
):  # fmt: skip
    """Compute the gates [A, E] (eq. 3). If TOP > 0, also the chosen experts [A, TOP], their weights
    [A, E] (eq. 5) and the keys [A].

    Ties go to the lowest index. POSITION: the router also receives xyz / extent.
    """
    anchor = tl.program_id(0) * B + tl.arange(0, B)
    inside = anchor < A
    row = tl.load(rows + anchor, mask=inside, other=0)
    anchor = anchor.to(tl.int64)
    column, expert = tl.arange(0, FP), tl.arange(0, EP)[None, :]
    f = tl.load(feature + row[:, None] * F + column[None, :], mask=inside[:, None] & (column[None, :] < F), other=0.0)
    R: tl.constexpr = F + 3 * POSITION
    w = tl.load(router_w + expert * R + column[:, None], mask=(expert < E) & (column[:, None] < F), other=0.0)
    logits = tl.dot(f, w, input_precision=PRECISION)
    if POSITION:
        for c in tl.static_range(3):
            x = tl.load(xyz + row * 3 + c, mask=inside, other=0.0) / extent
            logits += x[:, None] * tl.load(router_w + expert * R + F + c, mask=expert < E, other=0.0)
    if BIAS:
        logits += tl.load(router_b + expert, mask=expert < E, other=0.0)
    logits = tl.where(expert < E, logits, -float("inf"))
    p = tl.exp(logits - tl.max(logits, axis=1)[:, None])
    there = inside[:, None] & (expert < E)
    tl.store(gates + anchor[:, None] * E + expert, p / tl.sum(p, axis=1)[:, None], mask=there)
    if TOP > 0:
        key = tl.zeros((B,), tl.int32)
        for j in tl.static_range(TOP):
            best = tl.minimum(tl.argmax(logits, axis=1), E - 1)  # keeps the index in range if a logit is NaN
            tl.store(chosen + anchor * TOP + j, best.to(tl.int64), mask=inside)
            key = key | (1 << best)
            logits = tl.where(expert == best[:, None], -float("inf"), logits)
        mine = ((key[:, None] >> expert) & 1) == 1
        p = tl.where(mine, p, 0.0)
        tl.store(weight + anchor[:, None] * E + expert, p / tl.sum(p, axis=1)[:, None], mask=there)
        tl.store(keys + anchor, key, mask=inside)


@triton.jit(do_not_specialize=["A"])
def head_forward(
    rows, order, keys, weight, xyz, feature, camera, w1, b1, w2, b2, dst, out, A,
    E: tl.constexpr, F: tl.constexpr, H: tl.constexpr, K: tl.constexpr, C: tl.constexpr,
    DISTANCE: tl.constexpr, ROUTED: tl.constexpr, SPARSE: tl.constexpr, ACT: tl.constexpr, COMPACT: tl.constexpr,
    B: tl.constexpr, XP: tl.constexpr, HP: tl.constexpr, COLS: tl.constexpr, PRECISION: tl.constexpr,
):  # fmt: skip
    """Compute one attribute of a block of anchors (gather, direction, experts, mixture) and write
    it to `out`."""
    anchor, row, key, inside = block_of(order, keys, rows, tl.program_id(0), A, B, SPARSE)
    x = inputs(feature, xyz, camera, row, inside, F, DISTANCE, XP)
    y = tl.zeros((B, COLS), tl.float32)
    for e in range(E):
        mine = members(key, inside, e, SPARSE)
        if tl.max(mine.to(tl.int32), axis=0) > 0:
            h = relu(tl.dot(x, first_layer(w1, b1, e, H, F + 3 + DISTANCE, HP, XP), input_precision=PRECISION))
            w, b = second_layer(w2, b2, e, H, K * C, HP, COLS)
            a = activate(tl.dot(h, w, input_precision=PRECISION) + b[None, :], ACT)
            if ROUTED:
                a = a * tl.load(weight + anchor * E + e, mask=mine, other=0.0)[:, None]
            y += tl.where(mine[:, None], a, 0.0)
    at, there = outputs(dst, anchor, inside, K, C, COLS, COMPACT)
    tl.store(out + at, y, mask=there)


@triton.jit(do_not_specialize=["A"])
def head_backward(
    rows, order, keys, weight, gates, xyz, feature, camera, router_w, w1, b1, w2, b2, dst, d_out, d_gates, d_logits, d_feature, A,
    E: tl.constexpr, F: tl.constexpr, H: tl.constexpr, K: tl.constexpr, C: tl.constexpr,
    DISTANCE: tl.constexpr, ROUTED: tl.constexpr, SPARSE: tl.constexpr, ACT: tl.constexpr, COMPACT: tl.constexpr,
    B: tl.constexpr, XP: tl.constexpr, HP: tl.constexpr, COLS: tl.constexpr, EP: tl.constexpr, POSITION: tl.constexpr,
    OUTSIDE: tl.constexpr, PRECISION: tl.constexpr,
):  # fmt: skip
    """Add the gradient of one attribute, through networks and router, to `d_feature`. Write the
    gradient of the logits [A, E].

    OUTSIDE: the mixture weights are given. Their gradient [A, E] takes the place of that of the
    logits, and there is no router.
    """
    anchor, row, key, inside = block_of(order, keys, rows, tl.program_id(0), A, B, SPARSE)
    x = inputs(feature, xyz, camera, row, inside, F, DISTANCE, XP)
    at, there = outputs(dst, anchor, inside, K, C, COLS, COMPACT)
    dy = tl.load(d_out + at, mask=there, other=0.0)
    expert, column = tl.arange(0, EP)[None, :], tl.arange(0, XP)[None, :]
    dx, d_weight = tl.zeros((B, XP), tl.float32), tl.zeros((B, EP), tl.float32)
    for e in range(E):
        mine = members(key, inside, e, SPARSE)
        if tl.max(mine.to(tl.int32), axis=0) > 0:
            first = first_layer(w1, b1, e, H, F + 3 + DISTANCE, HP, XP)
            h = relu(tl.dot(x, first, input_precision=PRECISION))
            w, b = second_layer(w2, b2, e, H, K * C, HP, COLS)
            a = activate(tl.dot(h, w, input_precision=PRECISION) + b[None, :], ACT)
            back = tl.where(mine[:, None], dy, 0.0)
            if ROUTED:
                d_weight = tl.where((expert == e) & mine[:, None], tl.sum(back * a, axis=1)[:, None], d_weight)
                back = back * tl.load(weight + anchor * E + e, mask=mine, other=0.0)[:, None]
            dh = tl.dot(back * slope(a, ACT), tl.trans(w), input_precision=PRECISION)
            dx += tl.dot(tl.where(h > 0, dh, 0.0), tl.trans(first), input_precision=PRECISION)
    real = inside[:, None] & (expert < E)
    if OUTSIDE:
        tl.store(d_logits + anchor[:, None] * E + expert, d_weight, mask=real)
    elif ROUTED:
        g = tl.load(gates + anchor[:, None] * E + expert, mask=real, other=0.0)
        m = tl.load(weight + anchor[:, None] * E + expert, mask=real, other=0.0)
        d_g = tl.load(d_gates + anchor[:, None] * E + expert, mask=real, other=0.0)
        spread = d_weight - tl.sum(m * d_weight, axis=1)[:, None]
        d_logit = m * spread + g * (d_g - tl.sum(g * d_g, axis=1)[:, None])  # two softmaxes
        tl.store(d_logits + anchor[:, None] * E + expert, d_logit, mask=real)
        expert_down = tl.arange(0, EP)[:, None]
        r = tl.load(router_w + expert_down * (F + 3 * POSITION) + column, mask=(expert_down < E) & (column < F), other=0.0)
        dx += tl.dot(d_logit, r, input_precision=PRECISION)
    to = d_feature + row[:, None] * F + column
    kept = inside[:, None] & (column < F)
    tl.store(to, tl.load(to, mask=kept, other=0.0) + dx, mask=kept)


@triton.jit(do_not_specialize=["A", "blocks"])
def weight_backward(
    rows, order, keys, weight, xyz, feature, camera, w1, b1, w2, b2, dst, d_out, d_w1, d_b1, d_w2, d_b2, A, blocks,
    E: tl.constexpr, F: tl.constexpr, H: tl.constexpr, K: tl.constexpr, C: tl.constexpr,
    DISTANCE: tl.constexpr, ROUTED: tl.constexpr, SPARSE: tl.constexpr, ACT: tl.constexpr, COMPACT: tl.constexpr,
    B: tl.constexpr, XP: tl.constexpr, HP: tl.constexpr, COLS: tl.constexpr, PRECISION: tl.constexpr,
):  # fmt: skip
    """Program (e, p) sums the weight gradients of expert e over every P-th block. It writes part p
    of d_w1 [P, E, H, D] etc."""
    e, part = tl.program_id(0), tl.program_id(1)
    D: tl.constexpr = F + 3 + DISTANCE
    first = first_layer(w1, b1, e, H, D, HP, XP)
    w, b = second_layer(w2, b2, e, H, K * C, HP, COLS)
    sum1, sum2, sum_b = tl.zeros((XP, HP), tl.float32), tl.zeros((HP, COLS), tl.float32), tl.zeros((COLS,), tl.float32)
    for block in range(part, blocks, tl.num_programs(1)):
        anchor, row, key, inside = block_of(order, keys, rows, block, A, B, SPARSE)
        mine = members(key, inside, e, SPARSE)
        if tl.max(mine.to(tl.int32), axis=0) > 0:
            x = inputs(feature, xyz, camera, row, mine, F, DISTANCE, XP)
            h = relu(tl.dot(x, first, input_precision=PRECISION))
            a = activate(tl.dot(h, w, input_precision=PRECISION) + b[None, :], ACT)
            at, there = outputs(dst, anchor, mine, K, C, COLS, COMPACT)
            back = tl.load(d_out + at, mask=there, other=0.0)
            if ROUTED:
                back = back * tl.load(weight + anchor * E + e, mask=mine, other=0.0)[:, None]
            back = back * slope(a, ACT)
            sum_b += tl.sum(back, axis=0)
            sum2 += tl.dot(tl.trans(h), back, input_precision=PRECISION)
            dh = tl.dot(back, tl.trans(w), input_precision=PRECISION)
            sum1 += tl.dot(tl.trans(x), tl.where(h > 0, dh, 0.0), input_precision=PRECISION)
    mine_of_all = part * E + e
    unit, column, out = tl.arange(0, HP), tl.arange(0, XP)[:, None], tl.arange(0, COLS)
    across = unit[None, :]
    tl.store(d_w1 + (mine_of_all * H + across) * D + column, sum1, mask=(across < H) & (column < D))
    tl.store(d_b1 + mine_of_all * H + across + column * 0, sum1, mask=(across < H) & (column == D))
    real = out < K * C
    tl.store(d_w2 + (mine_of_all * K * C + out[None, :]) * H + unit[:, None], sum2, mask=(unit[:, None] < H) & real[None, :])
    tl.store(d_b2 + mine_of_all * K * C + out, sum_b, mask=real)


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
    length = tl.zeros((B, KP), tl.float32)
    for c in tl.static_range(4):
        q = tl.load(cov + d * 7 + 3 + c, mask=drawn, other=1.0)
        length += q * q
    length = tl.maximum(tl.sqrt_rn(length), EPS)
    for c in tl.static_range(4):
        tl.store(quats + d * 4 + c, tl.load(cov + d * 7 + 3 + c, mask=drawn, other=0.0) / length, mask=drawn)


@triton.jit(do_not_specialize=["A"])
def place_backward(
    rows, offsets, log_scaling, cov, dst, quats, d_means, d_quats, d_scales, d_opacities, d_raw,
    d_offsets, d_log_scaling, d_cov, d_opacity_head, A,
    K: tl.constexpr, B: tl.constexpr, KP: tl.constexpr,
):  # fmt: skip
    """Compute the gradients of offsets, log-scaling, `cov` [M, 7] and the opacities [A, K] of all
    slots from those of the Gaussians."""
    anchor = tl.program_id(0) * B + tl.arange(0, B)
    inside = anchor < A
    row = tl.load(rows + anchor, mask=inside, other=0)
    slot = tl.arange(0, KP)[None, :]
    real = inside[:, None] & (slot < K)
    at, own = anchor.to(tl.int64)[:, None] * K + slot, row[:, None] * K + slot
    d = tl.load(dst + at, mask=real, other=-1)
    drawn = d >= 0
    d_opacity = tl.load(d_raw + at, mask=real, other=0.0) + tl.load(d_opacities + d, mask=drawn, other=0.0)
    tl.store(d_opacity_head + at, d_opacity, mask=real)
    for c in tl.static_range(3):
        size = tl.exp(tl.load(log_scaling + row * 6 + c, mask=inside, other=0.0))
        bound = tl.exp(tl.load(log_scaling + row * 6 + 3 + c, mask=inside, other=0.0))
        d_offset = tl.load(d_means + d * 3 + c, mask=drawn, other=0.0) * size[:, None]
        tl.store(d_offsets + own * 3 + c, d_offset, mask=real)
        offset = tl.load(offsets + own * 3 + c, mask=drawn, other=0.0)
        tl.store(d_log_scaling + row * 6 + c, tl.sum(d_offset * offset, axis=1), mask=inside)
        part = activate(tl.load(cov + d * 7 + c, mask=drawn, other=0.0), 2)
        d_log = tl.load(d_scales + d * 3 + c, mask=drawn, other=0.0) * bound[:, None] * part
        tl.store(d_log_scaling + row * 6 + 3 + c, tl.sum(d_log, axis=1), mask=inside)
        tl.store(d_cov + d * 7 + c, d_log * (1.0 - part), mask=drawn)
    length, along = tl.zeros((B, KP), tl.float32), tl.zeros((B, KP), tl.float32)
    for c in tl.static_range(4):
        q = tl.load(cov + d * 7 + 3 + c, mask=drawn, other=1.0)
        length += q * q
        along += tl.load(quats + d * 4 + c, mask=drawn, other=0.0) * tl.load(d_quats + d * 4 + c, mask=drawn, other=0.0)
    length = tl.sqrt_rn(length)
    along = tl.where(length > EPS, along, 0.0)
    length = tl.maximum(length, EPS)
    for c in tl.static_range(4):
        q = tl.load(quats + d * 4 + c, mask=drawn, other=0.0)
        d_q = tl.load(d_quats + d * 4 + c, mask=drawn, other=0.0)
        tl.store(d_cov + d * 7 + 3 + c, (d_q - q * along) / length, mask=drawn)
