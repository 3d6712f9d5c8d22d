"""Turns the colours of points, which programs write as 0 to 255 or as fractions of 1, into
bytes."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from scene_experts.core.reading.numbers import expect_range

_OVER = 2.0  # fractions of 1 that are a little too bright stay below this; bytes that all do would be black


def to_bytes(values: NDArray[np.floating], path: Path) -> tuple[NDArray[np.uint8], list[str]]:
    """Return colours [P, 3] as uint8, and notes on what was decided.

    Colours are bytes, unless the file's largest value is at most 2 and some value is above 0 and
    no larger than 1: then all are fractions of 1. If only rows without a value above 1 have values
    between whole numbers, those rows are fractions and the others are bytes. Raises Damaged for
    values that are not from 0 to 255.
    """
    expect_range(values, "colours", 0, 255)
    if not values.size or not values.any():
        return values.astype(np.uint8), []
    between = (values % 1 != 0).any(1)
    most = float(values.max())
    if most <= 1 or (most <= _OVER and between.any()):
        return _round(values * 255), [f"the colours of {path.name} are read as fractions of 1: the largest is {most:g}"]
    bright = (values > 1).any(1)
    if not between.any() or (between & bright).any():
        return _round(values), []
    mixed = np.where(between[:, None], values * 255, values)
    note = (
        f"the colours of {path.name} are mixed: {int(between.sum()):,} of {len(values):,} points have fractions of 1, the others numbers "
        f"up to {most:g}; write the file in one unit if they look wrong"
    )
    return _round(mixed), [note]


def _round(values: NDArray[np.floating]) -> NDArray[np.uint8]:
    return np.clip(np.rint(values), 0, 255).astype(np.uint8)
