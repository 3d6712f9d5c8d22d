"""Means over scenes with their spread over seeds, and differences between recipes, paired by view
and seed."""

from __future__ import annotations

import statistics
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.special import stdtrit

from scene_experts.reproduce.store import Record

SEED_SD = {"psnr": 0.28, "ssim": 0.005, "lpips_3dgs": 0.005}
"""Assumed standard deviation over seeds of the difference of two runs on one capture, PSNR in dB:
that of the ten pairs of five recipes with three seeds on seven captures at 7,000 iterations, pooled
(results/moe-gs.md). Single pairs have 0.15 to 0.39 dB, 0.003 to 0.007 and 0.003 to 0.006."""
VIEW_SD = {"psnr": 0.4, "ssim": 0.003, "lpips_3dgs": 0.004}
"""The same over the views of a capture. Used for captures with a single view."""
SEED_WEIGHT = 4
"""Degrees of freedom of SEED_SD where it is pooled with the variance of the measured seeds."""
Verdict = Literal["confirmed", "contradicted", "undecided"]


def select(records: Sequence[Record], recipe: str, scene: str | None = None) -> list[Record]:
    """Select the records of a recipe, on one scene or on all."""
    return [r for r in records if r.recipe == recipe and (scene is None or r.scene == scene)]


def on_common_scenes(records: Sequence[Record], recipes: Iterable[str]) -> list[Record]:
    """Select the records of recipes on the scenes that every recipe with a run has: means over
    different scenes cannot be compared."""
    by = {recipe: rows for recipe in recipes if (rows := select(records, recipe))}
    scenes = set.intersection(*({r.scene for r in rows} for rows in by.values())) if by else set()
    return [r for rows in by.values() for r in rows if r.scene in scenes]


def on_common_runs(records: Sequence[Record], recipes: Iterable[str]) -> list[Record]:
    """As `on_common_scenes`, of the scenes with the seeds that every recipe with a run has: another
    seed moves a score too."""
    by = {recipe: rows for recipe in recipes if (rows := select(records, recipe))}
    runs = set.intersection(*({(r.scene, r.seed) for r in rows} for rows in by.values())) if by else set()
    return [r for rows in by.values() for r in rows if (r.scene, r.seed) in runs]


@dataclass(frozen=True)
class Mean:
    """A mean over scenes. `spread` is its standard deviation over seeds; None with one seed."""

    value: float
    spread: float | None


def complete_seeds(records: Sequence[Record]) -> set[int]:
    """Return the seeds with a record on every scene of a recipe's records."""
    scenes, seeds = {r.scene for r in records}, {r.seed for r in records}
    return {seed for seed in seeds if {r.scene for r in records if r.seed == seed} == scenes}


def mean(records: Sequence[Record], column: str) -> Mean | None:
    """Average a column over scenes for each seed, then over the seeds that have every scene. None
    where no record has a value."""
    found = {(r.seed, r.scene): value for r in records if (value := r.value(column)) is not None}
    if not found:
        return None
    scenes = sorted({scene for _, scene in found})
    by_seed = {
        seed: [found[seed, scene] for scene in scenes] for seed in {s for s, _ in found} if all((seed, scene) in found for scene in scenes)
    }
    if not by_seed:  # no seed has every scene: average each scene over its seeds, without a spread
        own = [statistics.fmean(v for (_, s), v in found.items() if s == scene) for scene in scenes]
        return Mean(statistics.fmean(own), None)
    means = [statistics.fmean(values) for values in by_seed.values()]
    return Mean(statistics.fmean(means), statistics.stdev(means) if len(means) > 1 else None)


@dataclass(frozen=True)
class Difference:
    """A - B in a score, paired by view and seed: mean over captures and 95 % interval. PSNR in
    dB."""

    mean: float
    low: float
    high: float
    captures: int
    seeds: tuple[int, int]
    """Least and greatest number of seeds of a capture."""
    views: int
    gains: int
    """Number of captures where A is above B."""
    fit: float | None = None
    """A - B in PSNR (dB) on training views in the second half of the trainings: tells whether A
    fits the training views better."""
    metric: str = "psnr"
    by_capture: dict[str, float] = field(default_factory=dict)
    """A - B on each capture: mean over seeds and views."""

    @property
    def over_captures(self) -> tuple[float, float] | None:
        """Ends of the 95 % interval of the mean with captures as the sample; None with fewer than
        three."""
        return estimate_over_captures(list(self.by_capture.values()))

    def verdict(self, sign: int) -> Verdict:
        """Judge the claim that A - B has a sign (+1 or -1).

        The difference has a sign where the whole interval and more than half of the captures have
        it.
        """
        most = 2 * self.gains - self.captures
        found = 1 if self.low > 0 and most > 0 else -1 if self.high < 0 and most < 0 else 0
        return "undecided" if found == 0 else "confirmed" if found == sign else "contradicted"


def difference(a: Sequence[Record], b: Sequence[Record], metric: str = "psnr") -> Difference | None:
    """Compute the difference of two recipes in a score of SEED_SD on the captures, seeds and views
    of both. None without a pair."""
    theirs = {(r.scene, r.seed): r for r in b}
    blocks: dict[str, dict[int, dict[str, float]]] = {}
    for record in a:
        other = theirs.get((record.scene, record.seed))
        if other is None:
            continue
        views = [v for v in record.per_view if metric in record.per_view[v] and metric in other.per_view.get(v, {})]
        if views:
            paired = {v: record.per_view[v][metric] - other.per_view[v][metric] for v in views}
            blocks.setdefault(record.scene, {})[record.seed] = paired
    if not blocks:
        return None
    grids = []
    for seeds in blocks.values():
        common = sorted(set.intersection(*(set(views) for views in seeds.values())))
        grids.append(np.array([[views[v] for v in common] for views in seeds.values()]))
    centre, half = estimate(grids, SEED_SD[metric], VIEW_SD[metric])
    counts = [len(grid) for grid in grids]
    views, gains = sum(grid.shape[1] for grid in grids), sum(bool(grid.mean() > 0) for grid in grids)
    seeds, means = (min(counts), max(counts)), {scene: float(grid.mean()) for scene, grid in zip(blocks, grids)}
    return Difference(centre, centre - half, centre + half, len(grids), seeds, views, gains, compare_fit(a, b), metric, means)


def estimate(grids: Sequence[NDArray[np.float64]], seed_sd: float, view_sd: float) -> tuple[float, float]:
    """Return the mean over captures of differences [seeds, views], and half the width of its 95 %
    interval.

    The interval covers other views and other seeds of the same captures. Its variance is a sum of
    two. The variance over views is that of each capture's views, averaged over seeds (`view_sd` for
    a single view). The variance over seeds is the same for all captures; it is pooled from the
    captures with several seeds and from `seed_sd`, which has SEED_WEIGHT degrees of freedom.
    Student's t, with the degrees of freedom of the sum after Satterthwaite (1946).
    """
    terms: list[tuple[float, int]] = []  # variance of the mean, degrees of freedom
    squares, freedom = SEED_WEIGHT * seed_sd**2, SEED_WEIGHT
    for grid in grids:
        views = grid.mean(0)
        variance = float(views.var(ddof=1)) if len(views) > 1 else view_sd**2
        terms.append((variance / len(views) / len(grids) ** 2, max(1, len(views) - 1)))
        squares += float(np.square(grid.mean(1) - grid.mean()).sum())
        freedom += len(grid) - 1
    terms.append((squares / freedom * sum(1 / len(grid) for grid in grids) / len(grids) ** 2, freedom))
    total = sum(variance for variance, _ in terms)
    together = total**2 / sum(variance**2 / degrees for variance, degrees in terms)
    return float(np.mean([grid.mean() for grid in grids])), student(together) * total**0.5


def estimate_over_captures(means: Sequence[float]) -> tuple[float, float] | None:
    """Return the ends of the 95 % interval of the mean of capture means, by Student's t. None for
    fewer than three captures.

    The captures are the sample, so the interval is about captures like these and not only about
    these.
    """
    if len(means) < 3:
        return None
    centre, half = statistics.fmean(means), student(len(means) - 1) * statistics.stdev(means) / len(means) ** 0.5
    return centre - half, centre + half


def student(freedom: float) -> float:
    """Return the 97.5 % quantile of Student's t for `freedom` degrees of freedom."""
    return float(stdtrit(freedom, 0.975))


def compare_fit(a: Sequence[Record], b: Sequence[Record]) -> float | None:
    """Average A - B in PSNR (dB) of the training views over the second half of the trainings
    (`Record.fit`), paired by run.

    Trainings with the same seed see the same views in the same order, whatever the recipe, unless
    one draws random backgrounds and the other does not: such pairs are left out. The mean is over
    seeds, then over captures. None where nothing pairs.
    """
    theirs = {_views_seen(r): r.fit for r in b}
    found: dict[str, list[float]] = {}
    for record in a:
        other = theirs.get(_views_seen(record))
        if record.fit is not None and other is not None:
            found.setdefault(record.scene, []).append(record.fit - other)
    return statistics.fmean(statistics.fmean(seeds) for seeds in found.values()) if found else None


def _views_seen(record: Record) -> tuple[str, int, bool, int]:
    """Return what decides which training views are drawn at which logged iteration, and over which
    background."""
    train = record.config.train
    return record.scene, record.seed, train.random_background, train.iterations


def clock_of(records: Iterable[Record]) -> str:
    """Return the column with the time of these trainings: CPU time where every record has it, else
    wall time."""
    return "cpu_seconds" if all(r.value("cpu_seconds") is not None for r in records) else "train_seconds"
