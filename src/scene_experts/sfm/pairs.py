"""Which photographs are compared with which."""

from __future__ import annotations

from itertools import combinations
from typing import Literal

Matching = Literal["auto", "exhaustive", "sequential"]
MOST = 300  # photographs that are all compared with each other: 44,850 pairs, some ten minutes on two cores
NEIGHBOURS = 10


def pairs(count: int, matching: Matching = "auto", neighbours: int = NEIGHBOURS) -> list[tuple[int, int]]:
    """Pairs (i, j), i < j, of `count` photographs in order.

    exhaustive: all.  sequential: each with its next `neighbours`, and with those 16, 32, 64, ... further on, which closes loops.
    auto: all up to MOST photographs, sequential beyond.
    """
    if matching == "exhaustive" or (matching == "auto" and count <= MOST):
        return list(combinations(range(count), 2))
    far = [1 << k for k in range(count.bit_length()) if 1 << k > neighbours]
    steps = [*range(1, neighbours + 1), *far]
    return [(i, i + step) for i in range(count) for step in steps if i + step < count]
