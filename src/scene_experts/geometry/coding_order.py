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
from scene_experts.geometry.morton import Keys, morton, unmorton
from scene_experts.native import library as native

Ints = NDArray[np.int32]

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
    def of(cls, keys: Keys, boxes: tuple[int, int], slow: bool = False) -> CodingOrder:
        """keys: [N] Morton keys, ascending. Raises Damaged for boxes that are none."""
        if not all(0 <= bits <= MOST_BITS for bits in boxes):
            raise Damaged(f"boxes of {boxes} bits")
        level = np.full(len(keys), LEVELS - 1, np.int8)
        for number in (1, 0):
            level[_firsts(keys, boxes[number])] = number
        rows = [np.flatnonzero(level == number).astype(np.int32) for number in range(LEVELS)]
        order = np.concatenate(rows)
        place = np.empty(len(keys), np.int32)
        place[order] = np.arange(len(keys), dtype=np.int32)
        cells, parents = unmorton(keys).astype(np.int32), []
        for number, own in enumerate(rows):
            found, weights = find_parents(cells, own, np.flatnonzero(level < number).astype(np.int32), slow)
            parents.append((place[found] if len(keys) else found, weights))
        return cls(order, np.cumsum([len(own) for own in rows]).tolist(), parents)


def find_parents(cells: Ints, rows: Ints, coarse: Ints, slow: bool = False) -> tuple[Ints, Ints]:
    """The two rows before and the two after each of rows [n] among coarse [m], both ascending, and
    their weights by the distance of cells [N, 3]: [n, 4] both. slow: with numpy, the definition."""
    library = None if slow else native.load()
    if library is not None:
        cells, rows, coarse = (np.ascontiguousarray(a, np.int32) for a in (cells, rows, coarse))
        parents, weights = np.empty((len(rows), 4), np.int32), np.empty((len(rows), 4), np.int32)
        at = [a.__array_interface__["data"][0] for a in (cells, rows, coarse, parents, weights)]
        library.se_code_parents(at[0], at[1], len(rows), at[2], len(coarse), *at[3:])
        return parents, weights
    place = np.searchsorted(coarse, rows)[:, None] + np.arange(-2, 2)
    there = (place >= 0) & (place < len(coarse))
    parents = np.where(there, coarse[place.clip(0, max(len(coarse) - 1, 0))], 0) if len(coarse) else np.zeros_like(place)
    away = np.abs(cells[rows][:, None].astype(np.int64) - cells[parents]).sum(2)
    share = np.where(there, 65536 // (away + 1), 0)
    total = share.sum(1, keepdims=True)
    return parents.astype(np.int32), np.where(total > 0, share * 256 // np.maximum(total, 1), 0).astype(np.int32)


def order_rows(cells: NDArray[np.int64]) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.float32]]:
    """The level [N] of each row of cells [N, 3] from 0 to 2^21, the rows of its parents [N, 4] and their
    weights [N, 4], whose sum is about 1, or 0 on level 0."""
    keys, n = morton(cells), len(cells)
    along = np.argsort(keys, kind="stable")
    way = CodingOrder.of(keys[along], choose_boxes(keys[along]))
    rows, level = along[way.rows], np.zeros(n, np.int64)
    parents, weights = np.zeros((n, 4), np.int64), np.zeros((n, 4), np.float32)
    for number, places in enumerate(way.levels):
        own, (found, share) = rows[places], way.parents[number]
        level[own], parents[own], weights[own] = number, rows[found], share / 256
    return level, parents, weights
