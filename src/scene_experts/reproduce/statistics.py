"""Means over scenes with their spread over seeds, and differences between recipes paired over views and seeds."""

from __future__ import annotations

import statistics
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from scene_experts.reproduce.store import Record

DRAWS = 4000
SEED_NOISE = 0.3  # dB that another seed may change the difference of two runs on one capture by (docs/results.md: standard deviations)
Verdict = Literal["confirmed", "contradicted", "undecided"]


def of_recipe(records: Sequence[Record], recipe: str, scene: str | None = None) -> list[Record]:
    return [r for r in records if r.recipe == recipe and (scene is None or r.scene == scene)]


def shared(records: Sequence[Record], recipes: Iterable[str]) -> list[Record]:
    """The records of recipes that have any, on the scenes that all of these have: means over different scenes would compare scenes."""
    by = {recipe: rows for recipe in recipes if (rows := of_recipe(records, recipe))}
    scenes = set.intersection(*({r.scene for r in rows} for rows in by.values())) if by else set()
    return [r for rows in by.values() for r in rows if r.scene in scenes]


@dataclass(frozen=True)
class Mean:
    """A mean over scenes; `spread` is the standard deviation of that mean over seeds (None with one seed)."""

    value: float
    spread: float | None


def mean(records: Sequence[Record], column: str) -> Mean | None:
    """Mean over scenes of a column, per seed, then over the seeds that have every scene. None where nothing has it."""
    found = {(r.seed, r.scene): value for r in records if (value := r.value(column)) is not None}
    if not found:
        return None
    scenes = sorted({scene for _, scene in found})
    by_seed = {
        seed: [found[seed, scene] for scene in scenes] for seed in {s for s, _ in found} if all((seed, scene) in found for scene in scenes)
    }
    if not by_seed:  # no seed has every scene: the scenes' own means, and no spread
        own = [statistics.fmean(v for (_, s), v in found.items() if s == scene) for scene in scenes]
        return Mean(statistics.fmean(own), None)
    means = [statistics.fmean(values) for values in by_seed.values()]
    return Mean(statistics.fmean(means), statistics.stdev(means) if len(means) > 1 else None)


@dataclass(frozen=True)
class Difference:
    """A - B: the mean over captures with its 95 % interval, from differences paired over views and seeds."""

    mean: float
    low: float
    high: float
    captures: int
    seeds: int
    views: int
    gains: int
    """Captures on which A is above B."""
    fit: float | None = None
    """A - B in PSNR (dB) on training views over the second half of the trainings: whether A fits better, generalised or not."""

    def verdict(self, sign: int) -> Verdict:
        """Whether A - B has the claimed sign (+1 or -1), its opposite, or may be either.

        A sign is one where the interval and most of the captures have it: a large gain on one of three is no rule.
        """
        most = 2 * self.gains - self.captures
        found = 1 if self.low > 0 and most > 0 else -1 if self.high < 0 and most < 0 else 0
        return "undecided" if found == 0 else "confirmed" if found == sign else "contradicted"


def difference(a: Sequence[Record], b: Sequence[Record], metric: str = "psnr") -> Difference | None:
    """Differences of a per-view metric between two recipes, on the captures, seeds and views that both have.

    The interval is a bootstrap within captures: views and seeds are drawn anew, captures stay, so it speaks of these captures alone.
    One seed cannot tell what another would change: the interval is then at least SEED_NOISE / sqrt(captures) to each side.
    None where nothing pairs.
    """
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
    random = np.random.default_rng(0)
    drawn, centres = np.zeros(DRAWS), []
    for seeds in blocks.values():
        common = sorted(set.intersection(*(set(views) for views in seeds.values())))
        grid = np.array([[views[v] for v in common] for views in seeds.values()])  # [S, V]
        centres.append(grid.mean())
        s = random.integers(0, grid.shape[0], (DRAWS, grid.shape[0]))
        v = random.integers(0, grid.shape[1], (DRAWS, grid.shape[1]))
        drawn += grid[s[:, :, None], v[:, None, :]].mean((1, 2)) / len(blocks)
    low, high = np.quantile(drawn, [0.025, 0.975])
    centre = float(np.mean(centres))
    least = SEED_NOISE * sum(len(seeds) == 1 for seeds in blocks.values()) ** 0.5 / len(blocks)
    low, high = min(float(low), centre - least), max(float(high), centre + least)
    views = sum(len(next(iter(seeds.values()))) for seeds in blocks.values())
    return Difference(centre, low, high, len(blocks), max(map(len, blocks.values())), views, sum(c > 0 for c in centres), fit(a, b))


def fit(a: Sequence[Record], b: Sequence[Record]) -> float | None:
    """Mean A - B in PSNR (dB) of the view trained on, paired over the iterations of the second half that both curves have.

    The same seed shows the same views in the same order, whatever the recipe. Mean over seeds, then captures; None where nothing pairs.
    """
    theirs = {(r.scene, r.seed): training_psnr(r) for r in b}
    found: dict[str, list[float]] = {}
    for record in a:
        mine, other = training_psnr(record), theirs.get((record.scene, record.seed), {})
        steps = [step for step in mine if step in other and 2 * step > record.config.train.iterations]
        if steps:
            found.setdefault(record.scene, []).append(statistics.fmean(mine[step] - other[step] for step in steps))
    return statistics.fmean(statistics.fmean(seeds) for seeds in found.values()) if found else None


def training_psnr(record: Record) -> dict[int, float]:
    """PSNR (dB) of the view of an iteration, by iteration."""
    return {point["step"]: point["psnr"] for point in record.curves if point.get("psnr") is not None}
