"""`reproduce compare`: any recipes beside a baseline, with the differences capture by capture and their intervals."""

from __future__ import annotations

from collections.abc import Sequence

from scene_experts.core.errors import InputError, nearest
from scene_experts.evaluate.tables import ResultTable
from scene_experts.recipes import RECIPES
from scene_experts.reproduce.experiments import DATASETS, Experiment
from scene_experts.reproduce.options import ReproduceOptions
from scene_experts.reproduce.statistics import SEED_SD, Difference, difference
from scene_experts.reproduce.store import Record
from scene_experts.reproduce.tables import COLUMNS

COMPARE = "compare"
DIGITS = {"psnr": 2, "ssim": 4, "lpips_3dgs": 4}


def make_comparison(options: ReproduceOptions) -> Experiment:
    """Return the comparison of --recipes with --baseline, by default the first recipe. Raises InputError for unknown recipes."""
    recipes, baselines = options.recipes, options.baseline or options.recipes[:1]
    if len(set(recipes)) < 2:
        raise InputError(f"expected two or more --recipes with compare, found {len(set(recipes))}; name the recipes to compare")
    for recipe in recipes:
        if recipe not in RECIPES:
            raise InputError(f"expected --recipes among {', '.join(RECIPES)}, found '{recipe}'{nearest(recipe, RECIPES)}; change it")
    for recipe in baselines:
        if recipe not in recipes:
            raise InputError(f"expected --baseline among --recipes ({', '.join(recipes)}), found '{recipe}'; change one of them")
    return Experiment(
        COMPARE,
        f"Comparison of {', '.join(recipes)}",
        {recipe: recipe for recipe in recipes},
        tuple(DATASETS),
        added=("anchors", "active_percent", "gaussians_rendered", "cpu_seconds"),
        baselines=tuple(baselines),
    )


def make_difference_tables(experiment: Experiment, records: Sequence[Record], scenes: Sequence[str]) -> dict[str, ResultTable]:
    """Return, for each baseline of an experiment and each score, the table of the differences from it on `scenes`."""
    here = [r for r in records if r.scene in scenes]
    made = {}
    for baseline in experiment.baselines:
        for score in SEED_SD:
            table = make_difference_table(here, list(experiment.rows.values()), baseline, score, scenes)
            if table.rows:
                made[f"{COLUMNS[score].title} minus that of {baseline}"] = table
    return made


def make_difference_table(
    records: Sequence[Record], recipes: Sequence[str], baseline: str, score: str, scenes: Sequence[str]
) -> ResultTable:
    """Return the table of the differences of recipes from a baseline in a score: each capture, the mean and both intervals.

    Each difference is paired by view and seed. Recipes that share no run with the baseline have no row.
    """
    base, digits = [r for r in records if r.recipe == baseline], DIGITS[score]
    rows, notes = [], []
    seeds = sorted({r.seed for r in records})
    for recipe in recipes:
        found = None if recipe == baseline else difference([r for r in records if r.recipe == recipe], base, score)
        if found is None:
            continue
        cells = [f"{found.by_capture[s]:+.{digits}f}" if s in found.by_capture else "-" for s in scenes]
        rows.append((recipe, *cells, f"{found.mean:+.{digits}f}", *intervals(found, digits)))
        lacking = [s for s in scenes if s not in found.by_capture]
        if lacking:
            notes.append(f"{recipe}: no pair of runs on {', '.join(lacking)}.")
        if found.seeds[0] < len(seeds):
            notes.append(f"{recipe}: {found.seeds[0]} of the {len(seeds)} seeds on some captures.")
    about = f"Paired by view and seed (seed{'s' if len(seeds) > 1 else ''} {', '.join(map(str, seeds))})."
    titles = ("", *scenes, "mean", "95 % interval: other views and seeds", "95 % interval: other captures")
    return ResultTable(titles, tuple(rows), frozenset(), (about, *notes))


def intervals(found: Difference, digits: int) -> tuple[str, str]:
    """Write the two intervals of a difference; "-" for the second where there are too few captures."""
    first = f"{found.low:+.{digits}f} to {found.high:+.{digits}f}"
    across = found.over_captures
    return first, "-" if across is None else f"{across[0]:+.{digits}f} to {across[1]:+.{digits}f}"
