# pyright: basic, reportMissingImports=false
"""Triton kernels of the routing in the CUDA decode: gates, chosen experts, the order of the anchors
and the gradients of the routers. `triton_decode` calls them.

Arrays of routing hold those of all three heads, as in `triton_kernels`: head h has its gates and
weights at h * stride * EM, its chosen experts at h * stride * TOP, and its keys and order at
h * stride. The bits of HEADS are the heads that a launch is for.
"""

from __future__ import annotations

import triton
import triton.language as tl


@triton.jit
def pick(head, a, b, c):
    """Return the pointer of a head."""
    found = a
    if head == 1:
        found = b
    if head == 2:
        found = c
    return found


@triton.jit
def count_block(counts, key, inside, head, block, blocks, BINS: tl.constexpr):
    """Write how many anchors of the block have each key to column `block` of `counts` [3, BINS,
    blocks]."""
    slot = tl.arange(0, BINS)
    found = (key[:, None] == slot[None, :]) & inside[:, None]
    tl.store(counts + (head * BINS + slot).to(tl.int64) * blocks + block, tl.sum(found.to(tl.int32), axis=0))


@triton.jit(do_not_specialize=["A", "stride", "blocks"])
def route(
    rows, xyz, feature, w0, w1, w2, b0, b1, b2, gates, weight, chosen, keys, counts, A, stride, blocks, extent,
    F: tl.constexpr, E: tl.constexpr, EM: tl.constexpr, TOP: tl.constexpr, HEADS: tl.constexpr, BIAS: tl.constexpr, POSITION: tl.constexpr,
    BINS: tl.constexpr, B: tl.constexpr, FP: tl.constexpr, EP: tl.constexpr, PRECISION: tl.constexpr,
):  # fmt: skip
    """Compute the gates [A, E] (eq. 3). If TOP > 0, also the chosen experts [A, TOP], their weights
    [A, E] (eq. 5), the keys [A] and, if BINS > 0, how often each occurs. Grid: blocks, 3.

    Ties go to the lowest index. POSITION: the router also receives xyz / extent.
    """
    head = tl.program_id(1)
    if ((HEADS >> head) & 1) != 0:
        router_w, router_b = pick(head, w0, w1, w2), pick(head, b0, b1, b2)
        far = head * stride.to(tl.int64)
        gates += far * EM
        weight += far * EM
        chosen += far * TOP
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
            tl.store(keys + far + anchor, key, mask=inside)
            if BINS > 0:
                count_block(counts, key, inside, head, tl.program_id(0), blocks, BINS)


@triton.jit(do_not_specialize=["A", "stride", "blocks"])
def count_keys(
    rows, keys, counts, A, stride, blocks, HEADS: tl.constexpr, BY_ROW: tl.constexpr, BINS: tl.constexpr, B: tl.constexpr
):  # fmt: skip
    """Count the keys of each block, as `route` does. BY_ROW: they are those of the rows of the
    table. Grid: blocks, 3."""
    head = tl.program_id(1)
    if ((HEADS >> head) & 1) != 0:
        at = tl.program_id(0) * B + tl.arange(0, B)
        inside = at < A
        at = at.to(tl.int64)
        if BY_ROW:
            at = tl.load(rows + at, mask=inside, other=0)
        key = tl.load(keys + head * stride.to(tl.int64) + at, mask=inside, other=0)
        count_block(counts, key, inside, head, tl.program_id(0), blocks, BINS)


@triton.jit(do_not_specialize=["A", "stride", "to_stride", "blocks"])
def arrange(
    rows, keys, counted, order, A, stride, to_stride, blocks,
    HEADS: tl.constexpr, BY_ROW: tl.constexpr, BINS: tl.constexpr, B: tl.constexpr,
):  # fmt: skip
    """Write the indices of the anchors [A] int32, sorted by their keys, to `order`, that of head h
    at h * to_stride. Equal keys stay in their order. Grid: blocks, 3.

    `counted` [3, BINS, blocks] are the sums of `counts` up to and with each of its places, for each
    head.
    """
    head, block = tl.program_id(1), tl.program_id(0)
    if ((HEADS >> head) & 1) != 0:
        anchor = block * B + tl.arange(0, B)
        inside = anchor < A
        at = anchor.to(tl.int64)
        if BY_ROW:
            at = tl.load(rows + at, mask=inside, other=0)
        key = tl.load(keys + head * stride.to(tl.int64) + at, mask=inside, other=0)
        slot = tl.arange(0, BINS)
        found = ((key[:, None] == slot[None, :]) & inside[:, None]).to(tl.int32)
        before = tl.load(counted + (head * BINS + slot).to(tl.int64) * blocks + block) - tl.sum(found, axis=0)
        place = tl.sum(found * (before[None, :] + tl.cumsum(found, axis=0) - 1), axis=1)
        tl.store(order + head * to_stride.to(tl.int64) + place, anchor, mask=inside)


@triton.jit(do_not_specialize=["A", "stride", "blocks"])
def router_weights(
    rows, xyz, feature, d_logits, parts, A, stride, blocks, extent,
    AT0: tl.constexpr, AT1: tl.constexpr, AT2: tl.constexpr, WIDTH: tl.constexpr, HEADS: tl.constexpr, BIAS: tl.constexpr,
    POSITION: tl.constexpr, F: tl.constexpr, E: tl.constexpr, EM: tl.constexpr,
    B: tl.constexpr, RP: tl.constexpr, EP: tl.constexpr, PRECISION: tl.constexpr,
):  # fmt: skip
    """Write part p of the gradients of the routers, w [E, R] and then b [E], to row p of `parts` [P,
    WIDTH], those of head h from AT_h on. Grid: P, 3."""
    part, head = tl.program_id(0), tl.program_id(1)
    if ((HEADS >> head) & 1) != 0:
        d_logits += head * stride.to(tl.int64) * EM
        R: tl.constexpr = F + 3 * POSITION
        column, expert = tl.arange(0, RP)[None, :], tl.arange(0, EP)
        total = tl.zeros((EP, RP), tl.float32)
        for block in range(part, blocks, tl.num_programs(0)):
            anchor = block * B + tl.arange(0, B)
            inside = anchor < A
            row = tl.load(rows + anchor, mask=inside, other=0)
            x = tl.load(feature + row[:, None] * F + column, mask=inside[:, None] & (column < F), other=0.0)
            if POSITION:
                place = column - F
                seen = inside[:, None] & (place >= 0) & (place < 3)
                x += tl.load(xyz + row[:, None] * 3 + place, mask=seen, other=0.0) / extent
            x = tl.where(inside[:, None] & (column == R), 1.0, x)
            there = inside[:, None] & (expert[None, :] < E)
            d = tl.load(d_logits + anchor.to(tl.int64)[:, None] * E + expert[None, :], mask=there, other=0.0)
            total += tl.dot(tl.trans(d), x, input_precision=PRECISION)
        to = parts + part.to(tl.int64) * WIDTH + tl.where(head == 0, AT0, tl.where(head == 1, AT1, AT2))
        down = expert[:, None]
        tl.store(to + down * R + column, total, mask=(down < E) & (column < R))
        if BIAS:
            tl.store(to + E * R + down + column * 0, total, mask=(down < E) & (column == R))


@triton.jit(do_not_specialize=["A", "stride", "blocks"])
def load_gradients(
    gates, keys, parts, A, stride, blocks, factor,
    E: tl.constexpr, EM: tl.constexpr, HEADS: tl.constexpr, SPARSE: tl.constexpr, B: tl.constexpr, EP: tl.constexpr,
):  # fmt: skip
    """Write part p of the gradients of the load-balancing loss to row p of `parts` [P, 3, EM]:
    `factor` times how many anchors chose an expert (SPARSE), or times the sum of its gates. Grid:
    P, 3."""
    part, head = tl.program_id(0), tl.program_id(1)
    if ((HEADS >> head) & 1) != 0:
        far = head * stride.to(tl.int64)
        expert = tl.arange(0, EP)
        total = tl.zeros((EP,), tl.float32)
        for block in range(part, blocks, tl.num_programs(0)):
            anchor = block * B + tl.arange(0, B)
            inside = anchor < A
            if SPARSE:
                key = tl.load(keys + far + anchor, mask=inside, other=0)
                total += tl.sum(((key[:, None] >> expert[None, :]) & 1).to(tl.float32), axis=0)
            else:
                there = inside[:, None] & (expert[None, :] < E)
                own = far * EM + anchor.to(tl.int64)[:, None] * E + expert[None, :]
                total += tl.sum(tl.load(gates + own, mask=there, other=0.0), axis=0)
        tl.store(parts + (part * 3 + head) * EM + expert, factor * total, mask=expert < E)
