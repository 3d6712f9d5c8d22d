"""The Morton curve: keys that interleave the bits of the axes, so that near cells have near
keys."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Keys = NDArray[np.uint64]
AXIS_BITS = 21  # bits of a cell coordinate; 63 bits per key
_SPREAD = (  # (shift, mask): two zeros between every two bits of a 21-bit number
    (32, 0x001F00000000FFFF),
    (16, 0x001F0000FF0000FF),
    (8, 0x100F00F00F00F00F),
    (4, 0x10C30C30C30C30C3),
    (2, 0x1249249249249249),
)


def morton(cells: NDArray[np.int64]) -> Keys:
    """Keys [N] of cells [N, 3], each coordinate in [0, 2^21); x is the lowest of each three
    bits."""
    out = np.zeros(len(cells), np.uint64)
    for axis in range(3):
        value = cells[:, axis].astype(np.uint64)
        for shift, mask in _SPREAD:
            value = (value | (value << np.uint64(shift))) & np.uint64(mask)
        out |= value << np.uint64(axis)
    return out


def unmorton(keys: Keys) -> NDArray[np.int64]:
    """Cells [N, 3] of keys [N], the inverse of `morton`."""
    out = np.empty((len(keys), 3), np.int64)
    masks, shifted = [0x1FFFFF, *(mask for _, mask in _SPREAD)], np.empty(len(keys), np.uint64)
    for axis in range(3):
        value = keys >> np.uint64(axis)
        value &= np.uint64(masks[-1])
        for (shift, _), mask in zip(reversed(_SPREAD), reversed(masks[:-1])):
            value |= np.right_shift(value, np.uint64(shift), out=shifted)
            value &= np.uint64(mask)
        out[:, axis] = value
    return out
