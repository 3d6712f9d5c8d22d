# pyright: basic, reportMissingImports=false
"""Triton kernels of the networks in the CUDA decode; `triton_decode` calls them.

Each program processes a block of B anchors. Where experts are chosen, the anchors are sorted by
their set of chosen experts. Most blocks therefore evaluate only k experts, and the program mixes
their outputs in registers. No sum uses atomics, so the results are the same bits in every run.

Tiles are padded to powers of two: XP inputs, HP hidden units, COLS outputs, EP experts. The input
of a network is x = (feature, unit direction, distance, 1). The 1 multiplies the bias, so one matrix
product computes the first layer and one its gradient. A network that does not see the distance has
0 as its weights. Activations: TANH, NONE, SIGMOID.

Heads are numbered 0 opacity, 1 covariance, 2 colour. The kinds of a head are PLAIN (one network),
DENSE (all experts, with weights), SPARSE (the experts whose bits are set in a key, with weights)
and LOCAL (one expert, with weight 1). Arrays of routing hold those of all heads: head h has its
order and keys at h * stride, and its weights, gates and gradients of logits at h * stride * EM, where
EM is the largest number of experts. BY_ROW: keys and weights are those of the rows of the table,
not of the anchors of the view. `dst` [A * K] is the index of each slot among the drawn Gaussians, or
-1 if the slot is not drawn.

Triton compiles a kernel anew for a count that is 1 or divisible by 16, unless `do_not_specialize`
names it. The counts change in every step.
"""

from __future__ import annotations

import triton
import triton.language as tl

TANH, NONE, SIGMOID = 0, 1, 2
PLAIN, DENSE, SPARSE, LOCAL = 0, 1, 2, 3
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
def derivative(a, ACT: tl.constexpr):
    """Derivative of the activation, computed from its value `a`."""
    if ACT == 0:
        return 1.0 - a * a
    if ACT == 2:
        return a * (1.0 - a)
    return a * 0.0 + 1.0


@triton.jit
def inputs(feature, xyz, camera, row, mine, F: tl.constexpr, XP: tl.constexpr):
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
    x = tl.where(column == F + 3, length[:, None], x)
    x = tl.where(column == F + 4, 1.0, x)
    return tl.where(mine[:, None], x, 0.0)


@triton.jit
def first_layer(w1, b1, e, F: tl.constexpr, DISTANCE: tl.constexpr, H: tl.constexpr, HP: tl.constexpr, XP: tl.constexpr):
    """Weights [XP, HP] of the first layer of expert e. Row F + 3 is that of the distance, or 0, and
    row F + 4 the bias."""
    D: tl.constexpr = F + 3 + DISTANCE
    column, unit = tl.arange(0, XP)[:, None], tl.arange(0, HP)[None, :]
    w = tl.load(w1 + (e * H + unit) * D + column, mask=(column < D) & (unit < H), other=0.0)
    b = tl.load(b1 + e * H + unit, mask=unit < H, other=0.0)
    return tl.where(column == F + 4, b, w)


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
def members(key, inside, e, KIND: tl.constexpr):
    """Mask [B] of the anchors in the block that expert e decodes. Bit e of `key` [B] is set if
    expert e is chosen."""
    if KIND >= 2:
        inside = inside & (((key >> e) & 1) == 1)
    return inside


@triton.jit
def block_of(order, keys, rows, block, A, B: tl.constexpr, KIND: tl.constexpr, BY_ROW: tl.constexpr):
    """Anchors of a block: indices into `rows`, rows of the table, indices into arrays of routing,
    keys, and a mask of those that exist, [B] each."""
    place = block * B + tl.arange(0, B)
    inside = place < A
    anchor, key = place.to(tl.int64), place
    if KIND >= 2:
        anchor = tl.load(order + place, mask=inside, other=0).to(tl.int64)
    row = tl.load(rows + anchor, mask=inside, other=0)
    at = anchor
    if BY_ROW:
        at = row
    if KIND >= 2:
        key = tl.load(keys + at, mask=inside, other=0)
    return anchor, row, at, key, inside


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


@triton.jit
def decode_block(
    order, keys, weight, rows, xyz, feature, camera, w1, b1, w2, b2, dst, out, A,
    E: tl.constexpr, KIND: tl.constexpr, DISTANCE: tl.constexpr, BY_ROW: tl.constexpr,
    F: tl.constexpr, H: tl.constexpr, K: tl.constexpr, C: tl.constexpr, ACT: tl.constexpr, COMPACT: tl.constexpr,
    B: tl.constexpr, XP: tl.constexpr, HP: tl.constexpr, COLS: tl.constexpr, PRECISION: tl.constexpr,
):  # fmt: skip
    """Compute one attribute of a block of anchors (gather, direction, experts, mixture) and write
    it to `out`."""
    anchor, row, at_weight, key, inside = block_of(order, keys, rows, tl.program_id(0), A, B, KIND, BY_ROW)
    x = inputs(feature, xyz, camera, row, inside, F, XP)
    y = tl.zeros((B, COLS), tl.float32)
    for e in range(E):
        mine = members(key, inside, e, KIND)
        if tl.max(mine.to(tl.int32), axis=0) > 0:
            h = relu(tl.dot(x, first_layer(w1, b1, e, F, DISTANCE, H, HP, XP), input_precision=PRECISION))
            w, b = second_layer(w2, b2, e, H, K * C, HP, COLS)
            a = activate(tl.dot(h, w, input_precision=PRECISION) + b[None, :], ACT)
            if KIND == 1 or KIND == 2:
                a = a * tl.load(weight + at_weight * E + e, mask=mine, other=0.0)[:, None]
            y += tl.where(mine[:, None], a, 0.0)
    at, there = outputs(dst, anchor, inside, K, C, COLS, COMPACT)
    tl.store(out + at, y, mask=there)
    return anchor, inside, y


@triton.jit(do_not_specialize=["A"])
def opacity_forward(
    rows, order, keys, weight, xyz, feature, camera, w1, b1, w2, b2, raw, positive, A,
    E: tl.constexpr, KIND: tl.constexpr, DISTANCE: tl.constexpr, BY_ROW: tl.constexpr,
    F: tl.constexpr, H: tl.constexpr, K: tl.constexpr,
    B: tl.constexpr, XP: tl.constexpr, HP: tl.constexpr, COLS: tl.constexpr, PRECISION: tl.constexpr,
):  # fmt: skip
    """Write the opacities `raw` [A, K] of all slots, and 1 to `positive` [A, K] int32 where they
    are above 0, else 0. Grid: blocks."""
    anchor, inside, y = decode_block(
        order, keys, weight, rows, xyz, feature, camera, w1, b1, w2, b2, rows, raw, A,
        E, KIND, DISTANCE, BY_ROW, F, H, K, 1, 0, False, B, XP, HP, COLS, PRECISION,
    )  # fmt: skip
    at, there = outputs(rows, anchor, inside, K, 1, COLS, False)
    tl.store(positive + at, (y > 0).to(tl.int32), mask=there)


@triton.jit(do_not_specialize=["A", "stride"])
def shape_and_color_forward(
    rows, order, keys, weight, xyz, feature, camera, cw1, cb1, cw2, cb2, rw1, rb1, rw2, rb2, dst, cov, colors, A, stride,
    CE: tl.constexpr, CKIND: tl.constexpr, CDISTANCE: tl.constexpr, RE: tl.constexpr, RKIND: tl.constexpr, RDISTANCE: tl.constexpr,
    EM: tl.constexpr, ONE_ORDER: tl.constexpr, BY_ROW: tl.constexpr, F: tl.constexpr, H: tl.constexpr, K: tl.constexpr,
    B: tl.constexpr, XP: tl.constexpr, HP: tl.constexpr, CC: tl.constexpr, RC: tl.constexpr, PRECISION: tl.constexpr,
):  # fmt: skip
    """Write `cov` [M, 7] and `colors` [M, 3] of the drawn Gaussians. Grid: blocks, 2. ONE_ORDER:
    the order of the first head is that of all heads."""
    stride = stride.to(tl.int64)
    if tl.program_id(1) == 0:
        own = order if ONE_ORDER else order + stride
        decode_block(
            own, keys + stride, weight + stride * EM, rows, xyz, feature, camera, cw1, cb1, cw2, cb2, dst, cov, A,
            CE, CKIND, CDISTANCE, BY_ROW, F, H, K, 7, 1, True, B, XP, HP, CC, PRECISION,
        )  # fmt: skip
    else:
        own = order if ONE_ORDER else order + 2 * stride
        decode_block(
            own, keys + 2 * stride, weight + 2 * stride * EM, rows, xyz, feature, camera, rw1, rb1, rw2, rb2, dst, colors, A,
            RE, RKIND, RDISTANCE, BY_ROW, F, H, K, 3, 2, True, B, XP, HP, RC, PRECISION,
        )  # fmt: skip


@triton.jit
def gradients_of_block(
    dx, x, anchor, key, inside, weight, gates, router, w1, b1, w2, b2, dst, d_out, d_gates, d_logits,
    E: tl.constexpr, KIND: tl.constexpr, DISTANCE: tl.constexpr, WITH_GATES: tl.constexpr, OUTSIDE: tl.constexpr, POSITION: tl.constexpr,
    F: tl.constexpr, H: tl.constexpr, K: tl.constexpr, C: tl.constexpr, ACT: tl.constexpr, COMPACT: tl.constexpr,
    B: tl.constexpr, XP: tl.constexpr, HP: tl.constexpr, COLS: tl.constexpr, EP: tl.constexpr, PRECISION: tl.constexpr,
):  # fmt: skip
    """Return `dx` [B, XP] plus the gradients of the inputs through one head. Write those of the logits
    [A, E].

    OUTSIDE: the mixture weights are given. Their gradients take the place of those of the logits, and
    there is no router. WITH_GATES: `d_gates` are gradients of the gates, [A, E] (1) or the same [E] for
    every anchor (2).
    """
    at, there = outputs(dst, anchor, inside, K, C, COLS, COMPACT)
    dy = tl.load(d_out + at, mask=there, other=0.0)
    expert, column = tl.arange(0, EP)[None, :], tl.arange(0, XP)[None, :]
    d_weight = tl.zeros((B, EP), tl.float32)
    for e in range(E):
        mine = members(key, inside, e, KIND)
        if tl.max(mine.to(tl.int32), axis=0) > 0:
            first = first_layer(w1, b1, e, F, DISTANCE, H, HP, XP)
            h = relu(tl.dot(x, first, input_precision=PRECISION))
            w, b = second_layer(w2, b2, e, H, K * C, HP, COLS)
            a = activate(tl.dot(h, w, input_precision=PRECISION) + b[None, :], ACT)
            back = tl.where(mine[:, None], dy, 0.0)
            if KIND == 1 or KIND == 2:
                d_weight = tl.where((expert == e) & mine[:, None], tl.sum(back * a, axis=1)[:, None], d_weight)
                back = back * tl.load(weight + anchor * E + e, mask=mine, other=0.0)[:, None]
            dh = tl.dot(back * derivative(a, ACT), tl.trans(w), input_precision=PRECISION)
            dx += tl.dot(tl.where(h > 0, dh, 0.0), tl.trans(first), input_precision=PRECISION)
    if KIND == 1 or KIND == 2:
        real = inside[:, None] & (expert < E)
        own = anchor[:, None] * E + expert
        if OUTSIDE:
            tl.store(d_logits + own, d_weight, mask=real)
        else:
            m = tl.load(weight + own, mask=real, other=0.0)
            d_logit = m * (d_weight - tl.sum(m * d_weight, axis=1)[:, None])  # two softmaxes
            if WITH_GATES:
                g = tl.load(gates + own, mask=real, other=0.0)
                if WITH_GATES == 1:
                    d_g = tl.load(d_gates + own, mask=real, other=0.0)
                else:
                    d_g = tl.load(d_gates + expert + 0 * own, mask=real, other=0.0)
                d_logit = d_logit + g * (d_g - tl.sum(g * d_g, axis=1)[:, None])
            tl.store(d_logits + own, d_logit, mask=real)
            expert_down = tl.arange(0, EP)[:, None]
            r = tl.load(router + expert_down * (F + 3 * POSITION) + column, mask=(expert_down < E) & (column < F), other=0.0)
            dx += tl.dot(d_logit, r, input_precision=PRECISION)
    return dx


@triton.jit(do_not_specialize=["A", "stride"])
def heads_backward(
    rows, order, keys, weight, gates, xyz, feature, camera, router0, router1, router2,
    ow1, ob1, ow2, ob2, cw1, cb1, cw2, cb2, rw1, rb1, rw2, rb2, dst, d_raw, d_cov, d_colors, d_gates0, d_gates1, d_gates2,
    d_logits, d_feature, A, stride,
    OE: tl.constexpr, OKIND: tl.constexpr, ODISTANCE: tl.constexpr, OOUT: tl.constexpr, OPOS: tl.constexpr,
    CE: tl.constexpr, CKIND: tl.constexpr, CDISTANCE: tl.constexpr, COUT: tl.constexpr, CPOS: tl.constexpr,
    RE: tl.constexpr, RKIND: tl.constexpr, RDISTANCE: tl.constexpr, ROUT: tl.constexpr, RPOS: tl.constexpr,
    EM: tl.constexpr, HEADS: tl.constexpr, ORDERED: tl.constexpr, BY_ROW: tl.constexpr, ADD: tl.constexpr, WITH_GATES: tl.constexpr,
    F: tl.constexpr, H: tl.constexpr, K: tl.constexpr,
    B: tl.constexpr, XP: tl.constexpr, HP: tl.constexpr, OC: tl.constexpr, CC: tl.constexpr, RC: tl.constexpr, EP: tl.constexpr,
    PRECISION: tl.constexpr,
):  # fmt: skip
    """Write the gradients of the features [N, F] through the heads whose bits are set in HEADS, and
    those of the logits. Grid: blocks. ADD: add to the gradients that are there.

    Several heads share one pass where their anchors have the same order, at `order`, or none
    (ORDERED).
    """
    stride = stride.to(tl.int64)
    place = tl.program_id(0) * B + tl.arange(0, B)
    inside = place < A
    anchor = place.to(tl.int64)
    if ORDERED:
        anchor = tl.load(order + place, mask=inside, other=0).to(tl.int64)
    row = tl.load(rows + anchor, mask=inside, other=0)
    at = row if BY_ROW else anchor
    x = inputs(feature, xyz, camera, row, inside, F, XP)
    dx = tl.zeros((B, XP), tl.float32)
    if (HEADS & 1) != 0:
        key = tl.load(keys + at, mask=inside, other=0) if OKIND >= 2 else anchor.to(tl.int32)
        d_gates = d_gates0
        dx = gradients_of_block(
            dx, x, anchor, key, inside, weight, gates,
            router0, ow1, ob1, ow2, ob2, dst, d_raw, d_gates, d_logits,
            OE, OKIND, ODISTANCE, WITH_GATES, OOUT, OPOS, F, H, K, 1, 0, False, B, XP, HP, OC, EP, PRECISION,
        )  # fmt: skip
    if (HEADS & 2) != 0:
        key = tl.load(keys + stride + at, mask=inside, other=0) if CKIND >= 2 else anchor.to(tl.int32)
        d_gates = d_gates0 + EM if WITH_GATES == 2 else d_gates1
        dx = gradients_of_block(
            dx, x, anchor, key, inside, weight + stride * EM, gates + stride * EM,
            router1, cw1, cb1, cw2, cb2, dst, d_cov, d_gates, d_logits + stride * EM,
            CE, CKIND, CDISTANCE, WITH_GATES, COUT, CPOS, F, H, K, 7, 1, True, B, XP, HP, CC, EP, PRECISION,
        )  # fmt: skip
    if (HEADS & 4) != 0:
        key = tl.load(keys + 2 * stride + at, mask=inside, other=0) if RKIND >= 2 else anchor.to(tl.int32)
        d_gates = d_gates0 + 2 * EM if WITH_GATES == 2 else d_gates2
        dx = gradients_of_block(
            dx, x, anchor, key, inside, weight + 2 * stride * EM, gates + 2 * stride * EM,
            router2, rw1, rb1, rw2, rb2, dst, d_colors, d_gates, d_logits + 2 * stride * EM,
            RE, RKIND, RDISTANCE, WITH_GATES, ROUT, RPOS, F, H, K, 3, 2, True, B, XP, HP, RC, EP, PRECISION,
        )  # fmt: skip
    column = tl.arange(0, XP)[None, :]
    to, kept = d_feature + row[:, None] * F + column, inside[:, None] & (column < F)
    if ADD:
        dx += tl.load(to, mask=kept, other=0.0)
    tl.store(to, dx, mask=kept)


@triton.jit
def sum_weights(
    order, keys, weight, rows, xyz, feature, camera, w1, b1, w2, b2, dst, d_out, to, A, blocks,
    E: tl.constexpr, KIND: tl.constexpr, DISTANCE: tl.constexpr, BY_ROW: tl.constexpr,
    F: tl.constexpr, H: tl.constexpr, K: tl.constexpr, C: tl.constexpr, ACT: tl.constexpr, COMPACT: tl.constexpr,
    B: tl.constexpr, XP: tl.constexpr, HP: tl.constexpr, COLS: tl.constexpr, PRECISION: tl.constexpr,
):  # fmt: skip
    """Sum the weight gradients of expert e over every P-th block. Write them to `to`: w1 [E, H, D], b1
    [E, H], w2 [E, K C, H], b2 [E, K C], one after the other."""
    e, part = tl.program_id(0), tl.program_id(1)
    D: tl.constexpr = F + 3 + DISTANCE
    OUT: tl.constexpr = K * C
    first = first_layer(w1, b1, e, F, DISTANCE, H, HP, XP)
    w, b = second_layer(w2, b2, e, H, OUT, HP, COLS)
    sum1, sum2, sum_b = tl.zeros((XP, HP), tl.float32), tl.zeros((HP, COLS), tl.float32), tl.zeros((COLS,), tl.float32)
    for block in range(part, blocks, tl.num_programs(1)):
        anchor, row, _, key, inside = block_of(order, keys, rows, block, A, B, KIND, BY_ROW)
        mine = members(key, inside, e, KIND)
        if tl.max(mine.to(tl.int32), axis=0) > 0:
            x = inputs(feature, xyz, camera, row, mine, F, XP)
            h = relu(tl.dot(x, first, input_precision=PRECISION))
            a = activate(tl.dot(h, w, input_precision=PRECISION) + b[None, :], ACT)
            at, there = outputs(dst, anchor, mine, K, C, COLS, COMPACT)
            back = tl.load(d_out + at, mask=there, other=0.0)
            if KIND == 1 or KIND == 2:
                back = back * tl.load(weight + anchor * E + e, mask=mine, other=0.0)[:, None]
            back = back * derivative(a, ACT)
            sum_b += tl.sum(back, axis=0)
            sum2 += tl.dot(tl.trans(h), back, input_precision=PRECISION)
            dh = tl.dot(back, tl.trans(w), input_precision=PRECISION)
            sum1 += tl.dot(tl.trans(x), tl.where(h > 0, dh, 0.0), input_precision=PRECISION)
    unit, column, out = tl.arange(0, HP), tl.arange(0, XP)[:, None], tl.arange(0, COLS)
    across = unit[None, :]
    tl.store(to + (e * H + across) * D + column, sum1, mask=(across < H) & (column < D))
    to += E * H * D
    tl.store(to + e * H + across + column * 0, sum1, mask=(across < H) & (column == F + 4))
    to += E * H
    real = out < OUT
    tl.store(to + (e * OUT + out[None, :]) * H + unit[:, None], sum2, mask=(unit[:, None] < H) & real[None, :])
    to += E * OUT * H
    tl.store(to + e * OUT + out, sum_b, mask=real)


@triton.jit(do_not_specialize=["A", "stride", "blocks"])
def heads_weights(
    rows, order, keys, weight, xyz, feature, camera, ow1, ob1, ow2, ob2, cw1, cb1, cw2, cb2, rw1, rb1, rw2, rb2,
    dst, d_raw, d_cov, d_colors, parts, A, stride, blocks,
    OE: tl.constexpr, OKIND: tl.constexpr, ODISTANCE: tl.constexpr, CE: tl.constexpr, CKIND: tl.constexpr, CDISTANCE: tl.constexpr,
    RE: tl.constexpr, RKIND: tl.constexpr, RDISTANCE: tl.constexpr, EM: tl.constexpr, ONE_ORDER: tl.constexpr, BY_ROW: tl.constexpr,
    C_AT: tl.constexpr, R_AT: tl.constexpr, WIDTH: tl.constexpr, F: tl.constexpr, H: tl.constexpr, K: tl.constexpr,
    B: tl.constexpr, XP: tl.constexpr, HP: tl.constexpr, OC: tl.constexpr, CC: tl.constexpr, RC: tl.constexpr, PRECISION: tl.constexpr,
):  # fmt: skip
    """Write part p of the weight gradients of all heads to row p of `parts` [P, WIDTH]: those of the
    covariance begin at C_AT, those of the colour at R_AT. Grid: EM, P, 3."""
    stride = stride.to(tl.int64)
    e, head = tl.program_id(0), tl.program_id(2)
    to = parts + tl.program_id(1).to(tl.int64) * WIDTH
    own = order if ONE_ORDER else order + head * stride
    keys += head * stride
    weight += head * stride * EM
    if head == 0:
        if e < OE:
            sum_weights(
                own, keys, weight, rows, xyz, feature, camera, ow1, ob1, ow2, ob2, dst, d_raw, to, A, blocks,
                OE, OKIND, ODISTANCE, BY_ROW, F, H, K, 1, 0, False, B, XP, HP, OC, PRECISION,
            )  # fmt: skip
    elif head == 1:
        if e < CE:
            sum_weights(
                own, keys, weight, rows, xyz, feature, camera, cw1, cb1, cw2, cb2, dst, d_cov, to + C_AT, A, blocks,
                CE, CKIND, CDISTANCE, BY_ROW, F, H, K, 7, 1, True, B, XP, HP, CC, PRECISION,
            )  # fmt: skip
    else:
        if e < RE:
            sum_weights(
                own, keys, weight, rows, xyz, feature, camera, rw1, rb1, rw2, rb2, dst, d_colors, to + R_AT, A, blocks,
                RE, RKIND, RDISTANCE, BY_ROW, F, H, K, 3, 2, True, B, XP, HP, RC, PRECISION,
            )  # fmt: skip
