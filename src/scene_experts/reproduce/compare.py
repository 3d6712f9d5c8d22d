"""`reproduce compare`: any recipes beside a baseline, with the differences capture by capture and
their intervals."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from scene_experts.core.errors import InputError
from scene_experts.evaluate.tables import ResultTable
from scene_experts.reproduce.experiments import DATASETS, Experiment
from scene_experts.reproduce.options import ReproduceOptions
from scene_experts.reproduce.statistics import SEED_SD, Difference, difference
from scene_experts.reproduce.store import Record
from scene_experts.reproduce.tables import COLUMNS
from scene_experts.reproduce.variants import read_line, split_name

COMPARE = "compare"
DIGITS = {"psnr": 2, "ssim": 4, "lpips_3dgs": 4}


def make_comparison(options: ReproduceOptions) -> Experiment:
    """Return the comparison of --recipes with --baseline, by default the first recipe.

    A recipe may have flags, and a name before them (see `variants.split_name`). Raises InputError
    for unknown recipes and flags.
    """
    rows = dict(split_name(text) for text in options.recipes)
    lines = list(rows.values())
    if len(set(lines)) < 2 or len(rows) < len(options.recipes):
        raise InputError(
            f"expected two or more different --recipes with compare, found {', '.join(options.recipes) or 'none'}; change them"
        )
    refined = [bool(read_line(line).refine_poses) for line in lines]
    if any(refined) and not all(refined):
        raise InputError(
            "expected recipes that all refine poses or none, found some with --refine-poses: their held-out cameras are aligned with their "
            "photographs before the scores, those of the others are not; score the runs with `eval --align-poses` and use `compare`"
        )
    baselines = options.baseline or tuple(rows)[:1]
    for name in baselines:
        if name not in rows:
            raise InputError(f"expected --baseline among --recipes ({', '.join(rows)}), found '{name}'; change one of them")
    return Experiment(
        COMPARE,
        f"Comparison of {', '.join(rows)}",
        rows,
        tuple(DATASETS),
        added=("lpips", "detail", "anchors", "active_percent", "gaussians_rendered", "cpu_seconds"),
        baselines=tuple(rows[name] for name in baselines),
    )


def make_difference_tables(experiment: Experiment, records: Sequence[Record], scenes: Sequence[str]) -> dict[str, ResultTable]:
    """Return, for each baseline of an experiment and each score, the table of the differences from
    it on `scenes`."""
    here = [r for r in records if r.scene in scenes]
    made, names = {}, {recipe: name for name, recipe in experiment.rows.items()}
    for baseline in experiment.baselines:
        for score in SEED_SD:
            table = make_difference_table(here, experiment.rows, baseline, score, scenes)
            if table.rows:
                made[f"{COLUMNS[score].title} minus that of {names[baseline]}"] = table
    return made


def make_difference_table(
    records: Sequence[Record], recipes: Mapping[str, str], baseline: str, score: str, scenes: Sequence[str]
) -> ResultTable:
    """Return the table of the differences of recipes from a baseline in a score: each capture, the
    mean and both intervals.

    `recipes` maps the title of each row to its recipe. Each difference is paired by view and seed.
    Recipes that share no run with the baseline have no row.
    """
    base, digits = [r for r in records if r.recipe == baseline], DIGITS[score]
    rows, notes = [], []
    seeds = sorted({r.seed for r in records})
    for name, recipe in recipes.items():
        found = None if recipe == baseline else difference([r for r in records if r.recipe == recipe], base, score)
        if found is None:
            continue
        cells = [f"{found.by_capture[s]:+.{digits}f}" if s in found.by_capture else "-" for s in scenes]
        rows.append((name, *cells, f"{found.mean:+.{digits}f}", *intervals(found, digits)))
        lacking = [s for s in scenes if s not in found.by_capture]
        if lacking:
            notes.append(f"{name}: no pair of runs on {', '.join(lacking)}.")
        if found.seeds[0] < len(seeds):
            where = "each capture" if found.seeds[0] == found.seeds[1] else "some captures"
            notes.append(f"{name}: {found.seeds[0]} of the {len(seeds)} seeds on {where}.")
    about = f"Paired by view and seed (seed{'s' if len(seeds) > 1 else ''} {', '.join(map(str, seeds))})."
    titles = ("", *scenes, "mean", "95 % interval: other views and seeds", "95 % interval: other captures")
    return ResultTable(titles, tuple(rows), frozenset(), (about, *notes))


def intervals(found: Difference, digits: int) -> tuple[str, str]:
    """Write the two intervals of a difference; "-" for the second where there are too few
    captures."""
    first = f"{found.low:+.{digits}f} to {found.high:+.{digits}f}"
    across = found.over_captures
    return first, "-" if across is None else f"{across[0]:+.{digits}f} to {across[1]:+.{digits}f}"
