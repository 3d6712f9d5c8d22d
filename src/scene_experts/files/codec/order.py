"""The order in which anchors are coded: three levels, coarse to fine, by their cells alone.

Anchors lie along the Morton curve. The first anchor of each large box of the curve is on level 0,
the first of each small box on level 1, the rest on level 2. The parents of an anchor are the two
before and the two after it on coarser levels.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from scene_experts.core.reading.budget import Damaged
from scene_experts.files.codec.reference import Ints
from scene_experts.files.codec.streams import find_parents
from scene_experts.files.formats.morton import Keys

LEVELS = 3
SHARES = (1 / 12, 1 / 3)  # of all anchors, at most: on level 0, and on levels 0 and 1
MOST_BITS = 63  # of a key


def choose_boxes(keys: Keys) -> tuple[int, int]:
    """The bits of a key that a box of level 0, and of level 1, leaves out: the fewest with which
    the levels have at most their shares. keys [N], ascending."""
    found = []
    for share in SHARES:
        bits = 0
        while bits < MOST_BITS and _firsts(keys, bits).sum() > max(1.0, share * len(keys)):
            bits += 1
        found.append(bits)
    return found[0], found[1]


def _firsts(keys: Keys, bits: int) -> NDArray[np.bool_]:
    boxes = keys >> np.uint64(bits)
    return np.concatenate([np.ones(min(len(keys), 1), bool), boxes[1:] != boxes[:-1]])


@dataclass(frozen=True)
class CodingOrder:
    """The rows of each level, ascending, and for each of them four parents and their weights."""

    rows: list[Ints]
    parents: list[tuple[Ints, Ints]]
    """By level: rows [n, 4], and weights [n, 4] in 1/256; all 0 on level 0."""

    @classmethod
    def of(cls, keys: Keys, cells: Ints, boxes: tuple[int, int], slow: bool = False) -> CodingOrder:
        """keys: [N] Morton keys, ascending; cells [N, 3]: theirs, from 0 to 2^21. Raises Damaged
        for boxes that are none."""
        if not all(0 <= bits <= MOST_BITS for bits in boxes):
            raise Damaged(f"boxes of {boxes} bits")
        level = np.full(len(keys), 2)
        for number in (1, 0):
            level[_firsts(keys, boxes[number])] = number
        rows = [np.flatnonzero(level == number).astype(np.int32) for number in range(LEVELS)]
        coarser = [np.flatnonzero(level < number).astype(np.int32) for number in range(LEVELS)]
        return cls(rows, [find_parents(cells, own, coarse, slow) for own, coarse in zip(rows, coarser)])
