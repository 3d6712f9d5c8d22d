"""Divides the minutes of a whole call among its stages, and adapts to how fast the machine is."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace

from scene_experts.bench.advice import FEW, Advice, suggest
from scene_experts.core.progress import Progress, Speedometer
from scene_experts.training.course import Course
from scene_experts.training.progress import format_duration

TRAINING = "training"  # the work whose parts become longer
FOR_PAGE = 0.03  # share of the time after the poses that the page gets
LEAST_PAGE, MOST_PAGE = 8.0, 30.0  # seconds that it gets; 5 to 7 were measured
FOR_SCORES = 0.15  # largest share that the scores get
SCORES, SCORE = 5.0, 6.0  # seconds of the scores, and of each view that has one: in all 9 to 19 of 2 views, 50 of 16
LOOK = 0.1  # share of the iterations after which the speed is known
CLOSE = (0.8, 1.3)  # a training whose time will be this share of what it has is not begun anew
LEAST, MOST, MOST_OF_FEW = 300, 30_000, 7_000  # iterations; the last with few photographs (`bench.advice.FEW`)
FIRST = 0.5
"""Share of the iterations that `info` proposes, without --minutes. Twice as many gain 0.1 to 0.6 dB and 5 to
8 % of LPIPS, and are three quarters of the whole time (results/to-page.md)."""
PAGE_GUESS = 10.0  # seconds of the page, without --minutes


@dataclass(frozen=True)
class TimeBudget:
    """Seconds for the whole; None: no limit."""

    seconds: float | None = None
    now: Callable[[], float] = time.monotonic
    began: float = field(default=-1.0)

    def __post_init__(self) -> None:
        if self.began < 0:
            object.__setattr__(self, "began", self.now())

    @property
    def left(self) -> float | None:
        """Seconds that are left, at least 0; None without a limit."""
        return None if self.seconds is None else max(0.0, self.began + self.seconds - self.now())

    def for_training(self, held: int) -> float | None:
        """Seconds that the training may take from now on. held: photographs that will be scored."""
        left = self.left
        if left is None:
            return None
        page = min(max(FOR_PAGE * left, LEAST_PAGE), MOST_PAGE)
        return max(0.0, left - page - min(guess_scores(held), FOR_SCORES * left))


def guess_scores(held: int) -> float:
    """Seconds that the scores of so many photographs take."""
    return SCORES + SCORE * held if held else 0.0


class Whole:
    """Tells how long the whole will still take, from the speed of its present stage and what the
    later stages are expected to take."""

    def __init__(self, progress: Progress, now: Callable[[], float] = time.monotonic) -> None:
        self.progress, self.now, self.what, self.pace = progress, now, "", Speedometer(now)
        self.course: Course | None = None  # of the training
        self.later = 0.0  # seconds of the stages after this one
        self.least: Callable[[], float] = lambda: 0.0  # seconds that the whole takes in any case

    def __call__(self, what: str, done: int, total: int) -> None:
        """Show that `done` of `total` parts of the work `what` are done."""
        if what != self.what:
            self.what, self.pace = what, Speedometer(self.now)
        course = self.course if what == TRAINING and self.course else Course(max(total, 1))
        now = course.spent(done)
        speed = self.pace(now)
        if speed is None or total <= 0:
            self.progress(what, done, total)
            return
        left = max(max(0.0, course.spent(total) - now) / speed + self.later, self.least())
        self.progress(f"{what} (about {format_duration(left)} left in all)", done, total)


def plan_training(width: int, height: int, views: int, have: float | None, slow: float = 1.0) -> Advice:
    """Return a training for photographs of this size that takes `have` seconds; None: what `suggest`
    proposes, with FIRST of its iterations.

    slow: How many times longer than estimated this machine takes. On CUDA, where nothing is
    estimated, how many times longer than `have` what `suggest` proposes takes.
    """
    limit = None if have is None else have / 60 / slow
    advice = suggest(width, height, views, limit=limit)
    if advice.minutes is None:
        return advice if have is None else replace(advice, iterations=_within(advice.iterations / slow, views))
    if limit is None:
        iterations = round(FIRST * advice.iterations)
    else:
        iterations = _within(advice.iterations * limit / advice.minutes, views)
    return replace(advice, iterations=iterations, minutes=advice.minutes * iterations / advice.iterations)


def _within(iterations: float, views: int) -> int:
    """Iterations between the fewest and the most for so many photographs."""
    return min(max(round(iterations), LEAST), MOST_OF_FEW if views <= FEW else MOST)


def find_slowness(course: Course, step: int, seconds: float, minutes: float | None, have: float) -> float | None:
    """Return how many times longer than the estimated minutes a training of this course will take,
    from the seconds of its first `step`; without an estimate, than `have`, the seconds that it has
    from its first iteration on. None where it will take about what it has."""
    expected = seconds * course.spent(course.total) / course.spent(max(step, 1))
    if CLOSE[0] <= expected / max(have, 1e-9) <= CLOSE[1]:
        return None
    return expected / 60 / minutes if minutes else expected / max(have, 1e-9)
