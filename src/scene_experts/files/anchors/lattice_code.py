"""Lattice cells in few bytes, exactly: sorted along the Morton curve, where the next anchor is near, and stored as steps along it.

Pure numpy, integers only. The curve interleaves the bits of the three axes, so a scene's shells of occupied cells become short steps; each
step takes as many 7-bit groups as it needs.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

AXIS_BITS = 21  # per axis; 63 bits in all
_GROUP = 7
_MAX_GROUPS = 9  # 63 bits
_SPREAD = (  # (shift, mask): between each two bits of a 21-bit number come two zeros
    (32, 0x001F00000000FFFF),
    (16, 0x001F0000FF0000FF),
    (8, 0x100F00F00F00F00F),
    (4, 0x10C30C30C30C30C3),
    (2, 0x1249249249249249),
)

Keys = NDArray[np.uint64]


def morton(cells: NDArray[np.int64]) -> Keys:
    """Keys [N] of cells [N, 3], each coordinate in [0, 2^21); x is the lowest bit of each triple."""
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
    masks = [0x1FFFFF, *(mask for _, mask in _SPREAD)]
    for axis in range(3):
        value = (keys >> np.uint64(axis)) & np.uint64(_SPREAD[-1][1])
        for i in range(len(_SPREAD) - 1, -1, -1):
            value = (value | (value >> np.uint64(_SPREAD[i][0]))) & np.uint64(masks[i])
        out[:, axis] = value.astype(np.int64)
    return out


def encode_steps(keys: Keys) -> NDArray[np.uint8]:
    """The bytes of sorted keys [N]: each step from the one before, low groups of 7 bits first, the top bit set while more follow."""
    steps = np.diff(keys, prepend=np.uint64(0))
    groups = np.stack([(steps >> np.uint64(_GROUP * i)).astype(np.uint8) & 0x7F for i in range(_MAX_GROUPS)], axis=1)
    more = np.stack([steps >> np.uint64(_GROUP * (i + 1)) != 0 for i in range(_MAX_GROUPS)], axis=1)
    used = np.concatenate([np.ones((len(steps), 1), bool), more[:, :-1]], axis=1)
    return np.where(more, groups | 0x80, groups).astype(np.uint8)[used]


def decode_steps(data: NDArray[np.uint8]) -> Keys:
    """The keys that `encode_steps` was given. Raises ValueError for bytes that it cannot have written."""
    if not len(data):
        return np.zeros(0, np.uint64)
    ends = np.flatnonzero(data < 0x80)
    if not len(ends) or ends[-1] != len(data) - 1:
        raise ValueError("a step is cut short")
    starts = np.concatenate([[0], ends[:-1] + 1])
    place = np.arange(len(data)) - np.repeat(starts, ends - starts + 1)
    if place.max() >= _MAX_GROUPS:
        raise ValueError("a step is too long")
    parts = (data & 0x7F).astype(np.uint64) << (_GROUP * place).astype(np.uint64)
    return np.cumsum(np.add.reduceat(parts, starts), dtype=np.uint64)
