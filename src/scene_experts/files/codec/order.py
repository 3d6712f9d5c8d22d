"""The order in which anchors are coded: three levels, coarse to fine, by their cells alone.

Along the Morton curve, the first anchor of each large box of the curve is on level 0, the first of
each small box on level 1, the rest on level 2. Anchors are coded level by level, along the curve
within a level. The parents of an anchor are the two before and the two after it on coarser levels.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from scene_experts.core.reading.budget import Damaged
from scene_experts.files.codec.reference import Ints
from scene_experts.files.codec.streams import find_parents
from scene_experts.files.formats.morton import Keys, unmorton

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
    """The order of anchors, and for each anchor four parents and their weights."""

    rows: Ints
    """[N]: places along the curve, in coding order"""
    ends: list[int]
    """By level: the first place in coding order after it."""
    parents: list[tuple[Ints, Ints]]
    """By level: places in coding order [n, 4], and weights [n, 4] in 1/256; all 0 on level 0."""

    @property
    def levels(self) -> list[slice]:
        """The places of each level in coding order."""
        return [slice(begin, end) for begin, end in zip([0, *self.ends], self.ends)]

    @classmethod
    def of(cls, keys: Keys, boxes: tuple[int, int], cells: Ints | None = None, slow: bool = False) -> CodingOrder:
        """keys: [N] Morton keys, ascending; cells: [N, 3], theirs, where they are known. Raises Damaged
        for boxes that are none."""
        if not all(0 <= bits <= MOST_BITS for bits in boxes):
            raise Damaged(f"boxes of {boxes} bits")
        level = np.full(len(keys), LEVELS - 1, np.int8)
        for number in (1, 0):
            level[_firsts(keys, boxes[number])] = number
        rows = [np.flatnonzero(level == number).astype(np.int32) for number in range(LEVELS)]
        order = np.concatenate(rows)
        place = np.empty(len(keys), np.int32)
        place[order] = np.arange(len(keys), dtype=np.int32)
        parents, cells = [], unmorton(keys).astype(np.int32) if cells is None else cells
        for number, own in enumerate(rows):
            found, weights = find_parents(cells, own, np.flatnonzero(level < number).astype(np.int32), slow)
            parents.append((place[found] if len(keys) else found, weights))
        return cls(order, np.cumsum([len(own) for own in rows]).tolist(), parents)
