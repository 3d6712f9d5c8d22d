"""Measure times as minima of interleaved runs, so that other work on the machine changes them
little."""

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
    peer: str = ""  # what the ratio compares with; empty: nothing
    ratio: float | None = None  # how many times faster than the peer
    note: str = ""


@dataclass(frozen=True)
class Missing:
    """A figure that cannot be measured on this machine, and why."""

    group: str
    name: str
    why: str


Result = Figure | Missing


def choose_clock(threads: int) -> Clock:
    """Processor time of this thread for one thread, else wall time."""
    return time.thread_time if threads == 1 else time.perf_counter


def measure_minima(
    subjects: Mapping[str, Subject], seconds: float, clock: Clock, runs: Mapping[str, int] | None = None
) -> dict[str, tuple[float, ...]]:
    """Return the minimum time of each part of each subject, s. Each round runs every subject once,
    until `seconds` have passed.

    Subjects run at least twice, because memory is cold in the first run.

    Args:
        subjects: Functions that run once and return the seconds of their parts, by name.
        seconds: Budget of wall time, s.
        clock: The clock for the measurements.
        runs: Maximum number of runs of slow subjects, by name. Their time does not count towards
            the budget.
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
