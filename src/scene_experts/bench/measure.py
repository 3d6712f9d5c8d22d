"""Times: the least of interleaved runs, so that other work on the machine blurs them little."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass

Clock = Callable[[], float]
Subject = Callable[[Clock], tuple[float, ...]]  # runs once and returns the seconds of its parts


@dataclass(frozen=True)
class Figure:
    """One measured line."""

    group: str
    name: str
    value: float
    unit: str
    peer: str = ""  # what the ratio is against; empty: it stands alone
    ratio: float | None = None  # how many times faster than the peer, or a share where the unit says so
    note: str = ""


@dataclass(frozen=True)
class Missing:
    """A figure that this machine cannot give, and why."""

    group: str
    name: str
    why: str


Result = Figure | Missing


def clock_for(threads: int) -> Clock:
    """Processor time of this thread where it works alone, else wall time."""
    return time.thread_time if threads == 1 else time.perf_counter


def least(
    subjects: Mapping[str, Subject], seconds: float, clock: Clock, runs: Mapping[str, int] | None = None
) -> dict[str, tuple[float, ...]]:
    """The least seconds of each part of each subject, over rounds that take every subject in turn until `seconds` of wall time are over.

    runs: how often a slow subject runs at most; its time does not count. The others run at least twice: the first run meets cold memory.
    """
    best: dict[str, tuple[float, ...]] = {}
    spent, turn, limits = 0.0, 0, runs or {}
    while due := {name: subject for name, subject in subjects.items() if turn < limits.get(name, turn + 1)}:
        if turn >= 2 and spent >= seconds:
            break
        for name, subject in due.items():
            began = time.perf_counter()
            found = subject(clock)
            spent += 0.0 if name in limits else time.perf_counter() - began
            best[name] = tuple(min(pair) for pair in zip(found, best.get(name, found), strict=True))
        turn += 1
    return best
