"""Which photographs are matched with each other. A pair takes half a second of a core, and all
pairs of 128 photographs more than an hour."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from itertools import combinations
from pathlib import Path

from scene_experts.sfm.options import Matching
from scene_experts.sfm.positions import find_near, read_positions
from scene_experts.sfm.retrieval import describe_photos, rank_alike

MOST_EXHAUSTIVE = 30  # photographs that are all matched with each other
NEIGHBOURS = 10  # following photographs that each photograph is matched with where the order alone decides
ALIKE = 10  # photographs that each is matched with because they look alike: with 8, all 128 of South Building get poses
FOLLOWING = 3  # and those that follow it in the order of the names
NEAR = 8  # and those that were taken nearest to it, where GPS says so
SPARE = 20  # more that look alike, for photographs that fit too few others


def choose_pairs(count: int, matching: Matching = "auto", neighbours: int = NEIGHBOURS) -> list[tuple[int, int]] | None:
    """Return the pairs (i, j), i < j, of `count` photographs in order that are matched with each
    other. None: their features decide (`find_alike`).

    "exhaustive": all pairs. "sequential": each photograph with its next `neighbours`, and with
    those 16, 32, 64, ... further on, which closes loops. "auto": exhaustive up to MOST_EXHAUSTIVE
    photographs, otherwise None.
    """
    if matching == "exhaustive" or (matching == "auto" and count <= MOST_EXHAUSTIVE):
        return list(combinations(range(count), 2))
    if matching == "auto":
        return None
    far = [1 << k for k in range(count.bit_length()) if 1 << k > neighbours]
    return follow(count, [*range(1, neighbours + 1), *far])


def follow(count: int, steps: list[int]) -> list[tuple[int, int]]:
    """Return the pairs of photographs that are one of `steps` apart."""
    return [(i, i + step) for i in range(count) for step in steps if i + step < count]


def find_alike(
    database: Path, names: list[str], places: Sequence[str] = (), *, film: bool = False
) -> tuple[list[tuple[int, int]], list[tuple[int, int]]]:
    """Return the pairs of photographs that are matched, and more pairs for those that fit too few
    others.

    places: Where each was taken, by any name: photographs of one place, such as the views of a
    panorama, are not matched. Each photograph is matched with the ALIKE that look most like it, with
    the FOLLOWING next ones and with the NEAR that were taken nearest to it, where their cameras noted
    the places. film: They are the frames of a video, of which those most alike show the scene from
    nearly one place; each is matched with those 8, 16, 32, ... further on, too.
    """
    at = list(places) or [str(i) for i in range(len(names))]
    most = max(Counter(at).values()) - 1  # others of one place
    ranks = [
        [int(j) for j in row if at[int(j)] != at[i]][: ALIKE + SPARE]
        for i, row in enumerate(rank_alike(describe_photos(database, names), ALIKE + SPARE + most))
    ]
    ordered = lambda i, j: (min(i, j), max(i, j))  # noqa: E731
    near = {ordered(i, j) for i, row in enumerate(ranks) for j in row[:ALIKE]}
    steps = [*range(1, FOLLOWING + 1), *([1 << k for k in range(3, len(names).bit_length())] if film else [])]
    near |= {*follow(len(names), steps), *find_near(read_positions(database, names), NEAR)}
    near = {(i, j) for i, j in near if at[i] != at[j]}
    more = {ordered(i, j) for i, row in enumerate(ranks) for j in row[ALIKE:]}
    return sorted(near), sorted(more - near)
