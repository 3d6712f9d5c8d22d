"""Turns the options of `scene-experts reproduce` into a plan: experiments, scenes and runs."""

from __future__ import annotations

import shlex
from dataclasses import dataclass, replace
from pathlib import Path

from scene_experts.core.errors import InputError, nearest
from scene_experts.data.fetch import catalog
from scene_experts.data.fetch.obtain import captures_dir
from scene_experts.reproduce.compare import COMPARE, make_comparison
from scene_experts.reproduce.experiments import EXPERIMENTS, OURS, Experiment
from scene_experts.reproduce.folds import check_folds, hold_out_each
from scene_experts.reproduce.options import ReproduceOptions
from scene_experts.reproduce.plan import (
    CaptureSpec,
    Scale,
    Spec,
    check_folders,
    drop_repeated,
    find_own_scenes,
    find_paper_scenes,
    list_runs,
)
from scene_experts.reproduce.variants import split_name
from scene_experts.training.config import check


@dataclass(frozen=True)
class StudyPlan:
    """The runs that the options request."""

    experiments: list[Experiment]
    scenes: list[CaptureSpec]
    shown: list[Spec]
    """The runs of the tables."""
    wanted: list[Spec]
    """The same without repeated trainings."""
    records: Path
    runs: Path


def make_plan(options: ReproduceOptions) -> StudyPlan:
    """The plan of the options.

    Raises InputError for unknown experiments, scenes and recipes, for settings that `train`
    refuses, and for folders that are files.
    """
    for folder in (options.out, options.runs, options.records):
        if folder and folder.exists() and not folder.is_dir():
            raise InputError(f"expected a folder at {folder}, found a file; choose another --out, --runs or --records")
    chosen, scenes = choose_experiments(options), choose_scenes(options)
    scale = Scale.of(options.scale, options.iterations, options.resolution)
    chosen = choose_rows(chosen, tuple(split_name(text)[1] for text in options.recipes)) if options.recipes else chosen
    if not options.tables_only:
        check_folders(scenes)
        if options.folds:
            check_folds(scenes, options.folds)
    held_out = hold_out_each(scenes, options.folds) if options.folds else scenes
    shown = list_runs(chosen, held_out, options.seeds or (0,), scale)
    for spec in shown:
        check(spec.train)
    records, runs = options.records or options.out / "records", options.runs or options.out / "runs"
    return StudyPlan(chosen, scenes, shown, drop_repeated(shown), records, runs)


def choose_rows(experiments: list[Experiment], recipes: tuple[str, ...]) -> list[Experiment]:
    """The experiments with only the rows of `recipes`. Raises InputError for a recipe that none of
    them has."""
    known = {recipe for experiment in experiments for recipe in experiment.rows.values()}
    for recipe in recipes:
        if recipe not in known:
            raise InputError(f"expected --recipes among {', '.join(sorted(known))}, found '{recipe}'{nearest(recipe, known)}; change it")
    few = [replace(e, rows={name: recipe for name, recipe in e.rows.items() if recipe in recipes}) for e in experiments]
    return [e for e in few if e.rows]


def choose_experiments(options: ReproduceOptions) -> list[Experiment]:
    """The experiments of the options. Raises InputError for an unknown name."""
    if not options.experiments:
        raise InputError(f"expected one or more of {', '.join(EXPERIMENTS)}, {COMPARE} or all, found none; name what to reproduce")
    names = list(dict.fromkeys(options.experiments))
    if options.baseline and COMPARE not in names:
        raise InputError(f"expected the experiment {COMPARE} with --baseline, found {', '.join(names)}; add it or leave --baseline out")
    if "all" in names:  # on other captures table 2 equals table 1
        names = [name for name in EXPERIMENTS if name not in OURS and (name != "table2" or not options.captures)]
    for name in names:
        if name not in EXPERIMENTS and name != COMPARE:
            hint = nearest(name, [*EXPERIMENTS, COMPARE])
            raise InputError(f"expected one of {', '.join(EXPERIMENTS)}, {COMPARE} or all, found '{name}'{hint}; change it")
    return [make_comparison(options) if name == COMPARE else EXPERIMENTS[name] for name in names]


def choose_scenes(options: ReproduceOptions) -> list[CaptureSpec]:
    """The captures of the options: the user's own, or the paper's scenes on this machine. Raises
    InputError for unknown scenes."""
    root = options.data or captures_dir()
    scenes = find_own_scenes(options.captures) if options.captures else find_paper_scenes(root)
    unknown = set(options.scenes) - {s.name for s in scenes}
    if unknown and options.captures:
        names = ", ".join(s.name for s in scenes)
        raise InputError(f"expected --scenes among the captures {names}, found {', '.join(sorted(unknown))}; change it")
    known = [scene.name for scene in catalog.SCENES]
    for name in sorted(unknown - set(known)):
        raise InputError(f"expected --scenes of the catalog, found '{name}'{nearest(name, known)}; see `scene-experts catalog`")
    if unknown or not scenes:
        what = ", ".join(sorted(unknown)) or "the paper's scenes"
        raise InputError(f"expected {what} in {root}, found none; fetch scenes with `scene-experts download`, or give --captures DIR...")
    return [s for s in scenes if not options.scenes or s.name in options.scenes]


def written_command(options: ReproduceOptions, scenes: list[CaptureSpec]) -> str:
    """The command that makes these tables and figures, without paths of this machine."""
    words = ["scene-experts", "reproduce", *options.experiments]
    if options.captures:
        words += ["--captures", *(shlex.quote(f"CAPTURES/{scene.name}") for scene in scenes)]
    for name in ("scenes", "scale", "iterations", "resolution", "seeds", "folds", "recipes", "baseline"):
        value = getattr(options, name)
        if value != getattr(ReproduceOptions(()), name):
            words += [f"--{name}", *(shlex.quote(str(item)) for item in (value if isinstance(value, tuple) else [value]))]
    return " ".join(words)
