"""A training that takes minutes on this machine: its resolution, its iterations, and an estimate of
its time."""

from __future__ import annotations

import time
from contextlib import suppress
from dataclasses import dataclass

import torch

from scene_experts.bench import raster, step
from scene_experts.bench.machine import read_processor_name
from scene_experts.core.errors import InputError, RunError
from scene_experts.core.io import cache_dir, read_json, write_json
from scene_experts.core.reading.budget import Damaged
from scene_experts.core.reading.numbers import number
from scene_experts.core.version import __version__
from scene_experts.render import choose, gsplat_install
from scene_experts.training.course import GROWN, Course, cost_of
from scene_experts.training.early import LEAST

LIMIT = 8.0  # minutes, so that a capture of few photographs, its training, scores and page take a quarter of an hour together
SIDES = ((0, 7000), (1200, 7000), (800, 7000), (800, 4000), (600, 4000), (600, 3000), (600, 2000), (400, 2000))
"""Longest side in pixels (0: as it is) and iterations, the best first."""
# Iterations take 6.4, 5.6, 5.7, 7.6 and 15.1 times the picture below on pyramid (0.10 megapixels),
# colosseum (0.23), banana (0.43), fox (0.52) and sceaux (1.08): more pixels bring more Gaussians,
# too. Larger photographs were not measured: there the time grows with the pixels alone.
FEW, FEW_ITERATIONS = 30, 4000
BASE, PER_MEGAPIXEL, MEASURED = 5.0, 9.5, 1.08
SHORT = 2.5  # minutes below which seconds are told
FREE = 0.85  # share of the processor from which a machine counts as idle
SERIAL = 0.15  # share of an iteration that one thread does


@dataclass(frozen=True)
class Advice:
    """A training and its estimated time."""

    side: int
    """Longest side of the photographs in pixels; 0: as they are."""
    iterations: int
    minutes: float | None
    """Estimated time on this machine while nothing else runs; None on CUDA, which is not
    measured."""

    @property
    def flags(self) -> list[str]:
        """The options of `train`."""
        side = [] if self.side == 0 else ["--resolution", f"longest:{self.side}"]
        return [*side, "--iterations", str(self.iterations)]

    def tell(self, share: float) -> str:
        """Say how long it takes where it gets this share of the processor (`measure_share`); empty
        if that is not known."""
        if self.minutes is None:
            return ""
        alone, now = (f"about {say_minutes(minutes)}" for minutes in (self.minutes, self.minutes / share))
        return f"{alone} on this machine" if share >= FREE else f"{now} beside what else this machine does now ({alone} alone)"


def say_minutes(minutes: float) -> str:
    """Say a time as whole minutes, or as tens of seconds where it is short."""
    return f"{round(minutes)} min" if minutes >= SHORT else f"{max(1, round(6 * minutes)) * 10} s"


def measure_picture() -> float:
    """CPU seconds that one thread takes for a picture of 20,000 Gaussians at 400x272 and its
    gradients. Takes about a second."""
    with step.use_threads(1):
        picture, rasterize = raster.make_picture(20_000, 400, 272), choose("auto", "cpu")
        return min(sum(raster.time_draw(rasterize, picture, time.process_time)) for _ in range(8))


def recall_picture() -> float:
    """The least that `measure_picture` has found on this machine, so that two commands in a row
    estimate the same. It is measured where the user's cache does not say it."""
    place, machine = cache_dir() / "speed.json", f"{read_processor_name()}, scene-experts {__version__}"
    try:
        known = read_json(place, "measured speed")
        return number(known[machine], "a measured speed", 1e-6, 1e3)  # type: ignore[index]
    except (InputError, Damaged, LookupError, TypeError):
        found = measure_picture()
    with suppress(RunError, OSError):
        place.parent.mkdir(parents=True, exist_ok=True)
        write_json(place, {machine: found})
    return found


def estimate_minutes(width: int, height: int, iterations: int, picture: float, threads: int) -> float:
    """Minutes of a training of the recipe that is proposed. picture: see `measure_picture`."""
    gain, pixels = 1 / (SERIAL + (1 - SERIAL) / threads), width * height / 1e6
    cost = cost_at(pixels)
    if (side := max(width, height)) >= LEAST:  # but never less than what is just small enough to be seen as it is
        cost = max(cost * share_of_half(pixels), cost_at(pixels * ((LEAST - 1) / side) ** 2))
    return iterations * picture * cost / gain / 60


def cost_at(pixels: float) -> float:
    """Return how many times longer than `measure_picture` an iteration takes with so many megapixels, in
    the mean of a training that sees all photographs as they are."""
    return BASE + PER_MEGAPIXEL * pixels * min(1.0, pixels / MEASURED)


def share_of_half(pixels: float) -> float:
    """Return how many times longer a training takes that sees its photographs of so many megapixels at
    half their size in the first half."""
    slower = cost_of(pixels) / cost_of(pixels / 4)
    half, whole = Course(2, GROWN, 1, slower), Course(2, GROWN)
    return half.spent(2) / slower / whole.spent(2)


def suggest(width: int, height: int, views: int, picture: float | None = None, limit: float | None = None) -> Advice:
    """Suggest a training for photographs of this size: the best one of SIDES that takes at most
    `limit` minutes (by default LIMIT), or the shortest.

    With FEW photographs or less, at most FEW_ITERATIONS: a longer training fits them better and
    what lies between them worse.

    views: number of photographs. picture: seconds from `measure_picture`; `recall_picture` by
    default.
    """
    if gsplat_install.is_likely():
        return Advice(0, 30_000, None)
    picture, threads = picture or recall_picture(), torch.get_num_threads()
    advice = Advice(0, SIDES[-1][1], 0.0)
    for side, iterations in SIDES:
        iterations = min(iterations, FEW_ITERATIONS) if views <= FEW else iterations
        if side >= max(width, height):
            side = 0
        scale = side / max(width, height) if side else min(1.0, 1600 / width)  # `train` limits the width to 1,600 px
        minutes = estimate_minutes(round(width * scale), round(height * scale), iterations, picture, threads)
        advice = Advice(side, iterations, minutes)
        if minutes <= (LIMIT if limit is None else limit):
            break
    return advice
