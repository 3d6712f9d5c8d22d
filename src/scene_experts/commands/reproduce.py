"""`scene-experts reproduce`: the paper's tables and figures from runs that are made, continued or reused."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

from rich.console import Console

from scene_experts.arguments.option import Option
from scene_experts.arguments.parse import Command, parse
from scene_experts.commands import PROG
from scene_experts.core.errors import InputError, RunError, expect_at_least, nearest
from scene_experts.core.signals import handled
from scene_experts.data.fetch import catalog
from scene_experts.data.fetch.obtain import captures_dir
from scene_experts.reproduce import report, store
from scene_experts.reproduce.experiments import EXPERIMENTS, OURS, Experiment
from scene_experts.reproduce.plan import Scale, Scene, Spec, check_folders, drop_repeated, find_own_scenes, find_paper_scenes, list_runs
from scene_experts.reproduce.runner import Failure, Runner, Say


@dataclass(frozen=True)
class ReproduceCommand:
    """Make the paper's tables and figures: runs what is missing, goes on with what was interrupted, reuses what is done."""

    experiments: Annotated[tuple[str, ...], Option(value="EXPERIMENT")]
    """table1, table2, table3, table4, fig1b, fig3, fig5, fig6, fig7, appendix, or all of them; or extras, which the paper has not."""
    captures: tuple[Path, ...] = ()
    """Your own captures, in place of the paper's scenes."""
    data: Path | None = None
    """Folder with the paper's scenes, as `scene-experts download --to` leaves them; by default where it puts them."""
    scenes: tuple[str, ...] = ()
    """Only these scenes."""
    out: Path = Path("reproduce")
    """Folder for tables, figures and records of runs."""
    runs: Path | None = None
    """Folder for run folders; OUT/runs by default."""
    records: Path | None = None
    """Folder for records of finished runs, which count as done; OUT/records by default. Experiments of several sizes may share one."""
    scale: float = 1.0
    """1 is the paper's size; less shortens the schedule and the pictures' sides together."""
    iterations: int | None = None
    """Length of each training, in place of what --scale gives."""
    resolution: str | None = None
    """Resolution policy (as-is, longest:PX, ...), in place of what --scale gives."""
    seeds: tuple[int, ...] = (0,)
    workers: int | None = None
    """Runs at a time, each in a process of its own; by default one, or one for each of --devices."""
    devices: tuple[str, ...] = ()
    """CUDA devices to share among the workers, by index."""
    recipes: tuple[str, ...] = ()
    """Only the rows of these recipes."""
    discard: bool = False
    """Remove each run folder once its record is written."""
    adopt: tuple[Path, ...] = ()
    """Run folders made elsewhere, to count as done where they are exactly what is asked for."""
    dry_run: bool = False
    """Say what would run, and run nothing."""
    tables_only: bool = False
    """Write the tables and figures of what is done, and run nothing."""


@dataclass(frozen=True)
class Plan:
    """What a command asks for: `shown` are the runs of its tables, `wanted` those of them that are different trainings."""

    experiments: list[Experiment]
    scenes: list[Scene]
    shown: list[Spec]
    wanted: list[Spec]
    records: Path
    runs: Path


def reproduce(args: list[str]) -> int:
    command = parse(ReproduceCommand, Command(f"{PROG} reproduce", ("--experiments",)), args)
    workers = command.workers if command.workers is not None else max(1, len(command.devices))
    expect_at_least([("--workers", workers, 1), *(("--seeds", seed, 0) for seed in command.seeds)])
    plan = planned(command)
    console = Console(highlight=False)
    say = lambda text: console.print(text, soft_wrap=True, markup=False)  # noqa: E731
    if not plan.wanted:
        say("nothing to run: these scenes are in none of these experiments")
    for run in command.adopt:
        say(f"adopted {report.adopt(run, plan.records)}")
    store.check_captures(store.load(plan.records), plan.wanted)
    if command.dry_run:
        tell(plan, say)
        return 0
    runner = Runner(plan.runs, plan.records, workers, command.devices, command.discard, say, artist(command, plan))
    failures = [] if command.tables_only else made(runner, plan, command.out)
    found = store.find_all(store.load(plan.records), plan.shown)
    for path in report.write(command.out, plan.experiments, plan.scenes, found, said(command, plan.scenes)):
        say(f"wrote {path}")
    if runner.stop.is_set():
        say("stopped; give the same command again to go on")
        return 130
    if failures:
        lines = "; ".join(f"{f.spec.label}: {f.why} ({f.log})" for f in failures)
        raise RunError(
            f"expected {len(plan.wanted)} runs to end well, found {len(failures)} that failed (what ended well is kept): {lines}"
        )
    return 0


def planned(command: ReproduceCommand) -> Plan:
    """Raises InputError for experiments, scenes or recipes that are none, and for folders that are files."""
    for folder in (command.out, command.runs, command.records):
        if folder and folder.exists() and not folder.is_dir():
            raise InputError(f"expected a folder at {folder}, found a file; choose another --out, --runs or --records")
    chosen, scenes = experiments_of(command), scenes_of(command)
    scale = Scale.of(command.scale, command.iterations, command.resolution)
    chosen = rows_of(chosen, command.recipes) if command.recipes else chosen
    if not command.tables_only:
        check_folders(scenes)
    shown = list_runs(chosen, scenes, command.seeds or (0,), scale)
    records, runs = command.records or command.out / "records", command.runs or command.out / "runs"
    return Plan(chosen, scenes, shown, drop_repeated(shown), records, runs)


def tell(plan: Plan, say: Say) -> None:
    """Which runs are done and which are not."""
    there = store.load(plan.records)
    done = [store.find(there, spec) is not None for spec in plan.wanted]
    for spec, is_done in zip(plan.wanted, done):
        say(f"{'done   ' if is_done else 'to run '} {spec.label}: {spec.train.iterations:,} iterations, {spec.data.resolution}")
    say(f"{len(plan.wanted)} runs, {sum(done)} of them done")


def artist(command: ReproduceCommand, plan: Plan) -> Callable[[Spec, Path], None]:
    """Draws Figure 5 from a run folder where the figure is asked for and the run is one of it, with the first seed."""
    figure5 = set(EXPERIMENTS["fig5"].rows.values()) if any(e.name == "fig5" for e in plan.experiments) else set()

    def draw(spec: Spec, folder: Path) -> None:
        if spec.recipe in figure5 and spec.seed == min(command.seeds or (0,)):
            report.draw_experts(spec, folder, command.out)

    return draw


def made(runner: Runner, plan: Plan, out: Path) -> list[Failure]:
    """Makes what is not done, and the pictures in `out` of what was done before they were asked for; returns the runs that failed."""
    with handled(lambda *_: runner.end()):
        failures = runner.run_all(plan.wanted)
    for spec in plan.wanted:
        folder = spec.folder(plan.runs)
        if (folder / "results.json").is_file() and not report.strip_path(out, spec.scene.name).is_file():
            try:
                runner.after(spec, folder)
            except InputError as error:
                runner.say(f"no picture of {spec.label}: {error}")
    return failures


def said(command: ReproduceCommand, scenes: list[Scene]) -> str:
    """The command that makes these tables and figures, without the places that are this machine's own."""
    words = [PROG, "reproduce", *command.experiments]
    if command.captures:
        words += ["--captures", *(f"CAPTURES/{scene.name}" for scene in scenes)]
    for name in ("scenes", "scale", "iterations", "resolution", "seeds", "recipes"):
        value = getattr(command, name)
        if value != getattr(ReproduceCommand(()), name):
            words += [f"--{name}", *(map(str, value) if isinstance(value, tuple) else [str(value)])]
    return " ".join(words)


def rows_of(experiments: list[Experiment], recipes: tuple[str, ...]) -> list[Experiment]:
    """The experiments with the rows of `recipes` alone. Raises InputError for a recipe that none of them has."""
    known = {recipe for experiment in experiments for recipe in experiment.rows.values()}
    for recipe in recipes:
        if recipe not in known:
            raise InputError(f"expected --recipes among {', '.join(sorted(known))}, found '{recipe}'{nearest(recipe, known)}; correct it")
    few = [replace(e, rows={name: recipe for name, recipe in e.rows.items() if recipe in recipes}) for e in experiments]
    return [e for e in few if e.rows]


def experiments_of(command: ReproduceCommand) -> list[Experiment]:
    """Raises InputError for a name that is no experiment."""
    if not command.experiments:
        raise InputError(f"expected what to reproduce ({', '.join(EXPERIMENTS)}, or all), found nothing; name one or more")
    names = list(dict.fromkeys(command.experiments))
    if "all" in names:  # on one's own captures table 2 is table 1 again
        names = [name for name in EXPERIMENTS if name not in OURS and (name != "table2" or not command.captures)]
    for name in names:
        if name not in EXPERIMENTS:
            hint = nearest(name, EXPERIMENTS)
            raise InputError(f"expected one of {', '.join(EXPERIMENTS)} or all, found '{name}'{hint}; correct the name")
    return [EXPERIMENTS[name] for name in names]


def scenes_of(command: ReproduceCommand) -> list[Scene]:
    """The captures to run on: the user's own, or those of the paper that are there."""
    root = command.data or captures_dir()
    scenes = find_own_scenes(command.captures) if command.captures else find_paper_scenes(root)
    unknown = set(command.scenes) - {s.name for s in scenes}
    if unknown and command.captures:
        names = ", ".join(s.name for s in scenes)
        raise InputError(f"expected --scenes among the captures {names}, found {', '.join(sorted(unknown))}; correct it")
    known = [scene.name for scene in catalog.SCENES]
    for name in sorted(unknown - set(known)):
        raise InputError(f"expected --scenes of the catalog, found '{name}'{nearest(name, known)}; see `{PROG} catalog`")
    if unknown or not scenes:
        what = ", ".join(sorted(unknown)) or "the paper's scenes"
        raise InputError(f"expected {what} in {root}, found none; fetch scenes with `{PROG} download`, or give --captures DIR...")
    return [s for s in scenes if not command.scenes or s.name in command.scenes]
