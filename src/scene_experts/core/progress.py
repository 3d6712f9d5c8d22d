"""Types of the callbacks that report progress, and the time that a work will still take."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable

Progress = Callable[[str, int, int], None]
"""Called with the name of the task, the number of completed parts and the total number of parts (0:
unknown)."""
ByteProgress = Callable[[int, int], None]
"""Called with the number of bytes transferred and the total number of bytes (0: unknown)."""

RECENT = 30.0  # seconds whose speed is extrapolated: a scene that grows, or a machine that others use, slows down
TICK = 0.5  # seconds between the times that are kept for it
SOON = 2.0  # seconds from which a speed says something


class Speedometer:
    """The speed of a work in its last RECENT seconds. The first call only begins it: what was done
    before, and what starting took, say nothing of the speed."""

    def __init__(self, now: Callable[[], float] = time.monotonic) -> None:
        self.now = now
        self.times: deque[tuple[float, float]] = deque()

    def __call__(self, done: float) -> float | None:
        """Parts per second when `done` parts are done; None while too little is known."""
        now, times = self.now(), self.times
        if not times or done < times[-1][1]:
            times.clear()
            times.append((now, done))
            return None
        while len(times) > 1 and now - times[1][0] >= RECENT:
            times.popleft()
        began, first = times[0]
        if now - times[-1][0] >= TICK and done > times[-1][1]:
            times.append((now, done))
        return (done - first) / (now - began) if done > first and now - began >= SOON else None
