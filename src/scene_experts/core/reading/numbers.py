"""Checks that parsed numbers are finite and within the range that the computations after them can
bear."""

from __future__ import annotations

import logging
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from scene_experts.core.reading.budget import Damaged

log: logging.Logger = logging.getLogger(__name__)
FARTHEST = 1e15
"""Largest magnitude of a position or length: its square and its multiples stay finite in
float32."""
LARGEST_LOG = 80.0
"""Largest logarithm of a length: exp(80) = 5e34 is finite in float32."""
LARGEST = 1e18
"""Largest magnitude of other values."""
_ROWS = 1 << 20  # values checked at a time: the temporaries stay small


def number(value: Any, what: str, low: float = -LARGEST, high: float = LARGEST) -> float:
    """Return `value` as a float. Raises Damaged unless it is a number from `low` to `high`."""
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not low <= value <= high:
        raise Damaged(f"{shown(value)} as {what}, which is not a number from {low:g} to {high:g}")
    return float(value)


def whole_number(value: Any, what: str, low: int = 0, high: int = 1 << 53) -> int:
    """Return `value` as an integer. Raises Damaged unless it is an integer from `low` to `high`."""
    if isinstance(value, bool) or not isinstance(value, int) or not low <= value <= high:
        raise Damaged(f"{shown(value)} as {what}, which is not an integer from {low:,} to {high:,}")
    return value


def to_size(value: Any) -> int:
    """Return a number of pixels, which some programs write as 1920.0. Raises ValueError unless it
    is a whole number."""
    size = int(value) if isinstance(value, (int, str)) and "." not in str(value) else float(value)
    if size != size // 1:  # True for NaN and infinity
        raise ValueError(f"{shown(value)} as a size")
    return int(size)


def shown(value: Any) -> str:
    """Return a short text for a value in an error message."""
    if isinstance(value, (int, float, str, bool, type(None))):
        text = f"an integer of {value.bit_length()} bits" if isinstance(value, int) and value.bit_length() > 128 else repr(value)[:60]
        return text
    return f"a value of type {type(value).__name__}"


def expect_range(values: NDArray[Any] | Tensor, what: str, low: float = -LARGEST, high: float = LARGEST) -> None:
    """Raise Damaged unless all values are finite and from `low` to `high`."""
    if isinstance(values, Tensor):
        if not values.numel():
            return
        least, most = (float(v) for v in torch.aminmax(values.detach()))
    else:
        if not values.size:
            return
        least, most = float(values.min()), float(values.max())
    if not (low <= least and most <= high):  # NaN fails every comparison
        kind = "others" if math.isfinite(least) and math.isfinite(most) else "values that are not finite"
        raise Damaged(f"{kind} where {what} between {low:g} and {high:g} are expected")


def expect_finite_tensors(tensors: Mapping[str, Tensor]) -> None:
    """Raise Damaged, with the name of the tensor, for floating-point values that are not finite."""
    for name, value in tensors.items():
        if not all_finite(value):
            raise Damaged(f"values that are not finite in {name}")


def all_finite(value: Tensor) -> bool:
    """Return whether all values are finite. It needs no memory of its own for large float32 and
    float64 tensors."""
    if value.is_complex():
        value = torch.view_as_real(value.detach().resolve_conj())
    if not value.numel() or not value.is_floating_point():
        return True
    if value.dtype in (torch.float32, torch.float64):
        least, most = torch.aminmax(value.detach())
        return math.isfinite(float(least)) and math.isfinite(float(most))
    flat = value.detach().reshape(-1)
    return all(bool(part.float().isfinite().all()) for part in flat.split(_ROWS))


def usable_rows(xyz: NDArray[Any], path: Path) -> NDArray[np.bool_]:
    """Return which points [P, 3] have a usable position: finite, and not beyond FARTHEST. Logs a
    warning if some have not."""
    kept: NDArray[np.bool_] = np.asarray((np.abs(xyz) <= FARTHEST).all(1))  # False for NaN
    if not kept.all():
        log.warning("dropped %s of %s points of %s that have no usable position", f"{(~kept).sum():,}", f"{len(xyz):,}", path)
    return kept
