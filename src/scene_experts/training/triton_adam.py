# pyright: basic, reportMissingImports=false
"""Triton kernel of one Adam step for all parameters; `optim.py` launches it and has the same step
in plain torch."""

from __future__ import annotations

import triton
import triton.language as tl

COLUMNS = tl.constexpr(10)


@triton.jit(do_not_specialize=["count"])
def step(table, count, beta2, rest1, rest2, eps, B: tl.constexpr):
    """Update B values of the tensor that this program belongs to.

    `table` [count, 10] int64 has one row per tensor: the addresses of value, gradient, first and
    second moment and rows (0: all rows), the number of values and of values per row, the first
    program, and the bits of two float64 numbers: the step size, and the root of the second bias
    correction. `rest1` and `rest2` are 1 - beta, formed in float64: from a beta in float32 they
    would be 1e-5 off.
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
    m = m + (g - m) * rest1
    v = v * beta2 + rest2 * g * g
    p = tl.load(value + at, mask=inside, other=0.0)
    tl.store(first + at, m, mask=inside)
    tl.store(second + at, v, mask=inside)
    tl.store(value + at, p - step_size * (m / (tl.sqrt_rn(v) / root + eps)), mask=inside)
