"""Measure wall time, CPU time and machine load of a training. Checkpoints store all three."""

from __future__ import annotations

import os
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any


def load_average() -> float | None:
    """Return the load average of the last minute, or None if the system does not report it
    (Windows)."""
    return round(os.getloadavg()[0], 2) if hasattr(os, "getloadavg") else None


@dataclass
class Clock:
    """Total time of the iterations, including those before a resume. Excludes saving, previews and
    evaluation."""

    seconds: float = 0.0
    """Wall time, s."""
    cpu_seconds: float | None = 0.0
    """User and system time of all threads of this process, s. None: unknown, for an
    imported or merged scene."""
    load: dict[str, float | None] = field(default_factory=lambda: {"cores": os.cpu_count(), "start": load_average()})
    """`cores` of the machine, and its load averages at the `start` and the `end` of the training;
    empty for an imported or merged scene."""

    @contextmanager
    def running(self) -> Iterator[None]:
        """Add the time of the block to the clock."""
        wall, cpu = time.perf_counter(), time.process_time()
        yield
        self.seconds += time.perf_counter() - wall
        if self.cpu_seconds is not None:
            self.cpu_seconds += time.process_time() - cpu

    def meta(self) -> dict[str, Any]:
        """Return the values that a checkpoint stores. The current load average is stored as
        `end`."""
        return {"seconds": self.seconds, "cpu_seconds": self.cpu_seconds, "load": {**self.load, "end": load_average()}}

    @classmethod
    def of(cls, meta: dict[str, Any]) -> Clock:
        """Create the clock from the metadata of a checkpoint."""
        return cls(float(meta["seconds"]), meta.get("cpu_seconds"), meta.get("load", {}))
