# pyright: basic, reportMissingImports=false
"""Unit quaternions for Triton kernels. `rotation.py` and `torch.nn.functional.normalize` are the
reference."""

import triton
import triton.language as tl

EPS = tl.constexpr(1e-12)  # keeps quaternions finite if their length is 0


@triton.jit
def write_unit(q, to, mask):
    """Write the quaternions at `q` (pointers to their first values) divided by their lengths to
    `to`, where `mask` is set."""
    length = tl.load(q, mask=mask, other=1.0)
    length *= length
    for c in tl.static_range(1, 4):
        value = tl.load(q + c, mask=mask, other=1.0)
        length += value * value
    length = tl.maximum(tl.sqrt_rn(length), EPS)
    for c in tl.static_range(4):
        tl.store(to + c, tl.load(q + c, mask=mask, other=1.0) / length, mask=mask)


@triton.jit
def write_unit_backward(q, unit, d_unit, to, mask):
    """Write the gradients of the quaternions at `q` to `to`, from those of `write_unit`'s result
    `unit`."""
    length = tl.load(q, mask=mask, other=1.0)
    length *= length
    along = tl.load(unit, mask=mask, other=0.0) * tl.load(d_unit, mask=mask, other=0.0)
    for c in tl.static_range(1, 4):
        value = tl.load(q + c, mask=mask, other=1.0)
        length += value * value
        along += tl.load(unit + c, mask=mask, other=0.0) * tl.load(d_unit + c, mask=mask, other=0.0)
    length = tl.sqrt_rn(length)
    along = tl.where(length > EPS, along, 0.0)
    length = tl.maximum(length, EPS)
    for c in tl.static_range(4):
        value = tl.load(unit + c, mask=mask, other=0.0)
        tl.store(to + c, (tl.load(d_unit + c, mask=mask, other=0.0) - value * along) / length, mask=mask)
