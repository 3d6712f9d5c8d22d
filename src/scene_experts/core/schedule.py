"""Schedules: intervals and learning rates."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated

from scene_experts.core.errors import InputError
from scene_experts.core.fields import SCALES, Count, Flag


@dataclass(frozen=True)
class Every:
    """True at the multiples of `interval` strictly between `start` and `stop` (as Scaffold-GS
    compares them)."""

    start: Annotated[int, SCALES]
    """Iteration after which it begins."""
    stop: Annotated[int, SCALES]
    """Iteration before which it ends."""
    interval: Count
    """Iterations between two steps."""

    def due(self, step: int) -> bool:
        return self.start < step < self.stop and step % self.interval == 0

    def count(self, last: int) -> int:
        """Return the number of iterations from 1 to `last` at which it is true."""
        return sum(self.due(step) for step in range(self.interval, min(self.stop, last + 1), self.interval))


def passes(step: int, views: int, interval: int) -> bool:
    """Return whether one of the `views` iterations up to `step` is a multiple of `interval`."""
    return step // interval > (step - views) // interval


@dataclass(frozen=True)
class Rate:
    """A learning rate that runs log-linearly from `first` to `last` over the training; 0 stays
    0."""

    first: float
    """At the first iteration."""
    last: float
    """At the last iteration."""

    def at(self, step: int, total: int) -> float:
        """Return the rate at `step` (1-based) of `total`: exp((1 - t/T) ln first + (t/T) ln last),
        with t clipped to [0, T]."""
        if self.first == 0.0 and self.last == 0.0:
            return 0.0
        if self.first == self.last:
            return self.first
        t = min(max(step / max(total, 1), 0.0), 1.0)
        return math.exp((1.0 - t) * math.log(self.first) + t * math.log(self.last))

    def times(self, factor: float) -> Rate:
        return Rate(self.first * factor, self.last * factor)

    def check(self, flag: Flag) -> None:
        if not (self.first > 0 < self.last or self.first == self.last == 0):
            raise InputError(f"expected {flag('')} to run between two rates above 0, or to be 0, found {self.first} and {self.last}")
