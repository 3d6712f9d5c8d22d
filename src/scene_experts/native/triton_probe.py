# pyright: basic, reportMissingImports=false
"""The smallest Triton kernel; `native/triton.py` runs it to see whether kernels compile on this
machine."""

from __future__ import annotations

import triton
import triton.language as tl


@triton.jit
def probe(to):
    """Write a 1."""
    tl.store(to, 1.0)
