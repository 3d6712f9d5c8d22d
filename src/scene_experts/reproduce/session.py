"""One call of `scene-experts reproduce`: train what is missing, then write the tables and
figures."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from scene_experts.core.errors import InputError, RunError
from scene_experts.core.fields import check_fields
from scene_experts.core.signals import handled
from scene_experts.reproduce import report, store
from scene_experts.reproduce.cluster import ClusterRunner
from scene_experts.reproduce.experiments import EXPERIMENTS
from scene_experts.reproduce.folds import find_incomplete, join
from scene_experts.reproduce.options import ReproduceOptions
from scene_experts.reproduce.plan import Spec
from scene_experts.reproduce.request import StudyPlan, make_plan, written_command
from scene_experts.reproduce.runner import Failure, Runner, Say


def reproduce(options: ReproduceOptions, say: Say) -> bool:
    """Run the missing experiments and write the tables and figures; returns False if a signal
    stopped it before the end.

    Raises InputError for options that do not fit, RunError if a run fails; the finished runs are
    kept.
    """
    check_fields(options)
    plan = make_plan(options)
    if not plan.wanted:
        say("nothing to run: these experiments have none of these scenes")
    adopted = [(run, report.adopt(run, plan.wanted)) for run in options.adopt]
    store.check_captures([*store.load(plan.records), *(record for _, record in adopted)], plan.wanted)
    if options.dry_run:
        list_plan(plan, [record for _, record in adopted], say)
        return True
    for run, record in adopted:
        say(f"adopted {run}: {store.write(plan.records, record)}")
    draw = figure_drawer(options, plan)
    runner = make_runner(options, plan, say, draw)
    failures = [] if options.tables_only else run_plan(runner, plan, options.out)
    found = store.find_all(store.load(plan.records), plan.shown)
    if options.folds:
        for line in find_incomplete(found, options.folds):
            say(line)
        found = join(found, options.folds)
    for path in report.write(options.out, plan.experiments, plan.scenes, found, written_command(options, plan.scenes)):
        say(f"wrote {path}")
    if runner.stop.is_set():
        say("stopped; repeat the command to continue")
        return False
    if failures:
        lines = "; ".join(f"{f.spec.label}: {f.why} ({f.log})" for f in failures)
        raise RunError(f"expected {len(plan.wanted)} runs to succeed, found {len(failures)} that failed; the others are kept: {lines}")
    return True


def make_runner(options: ReproduceOptions, plan: StudyPlan, say: Say, draw: Callable[[Spec, Path], None]) -> Runner:
    """The runner of the options: the workers of a cluster (--cluster), or processes of this
    machine."""
    if options.cluster is not None:
        cluster = {"address": options.cluster, "resources": options.needs()}
        return ClusterRunner(plan.runs.absolute(), plan.records.absolute(), discard=options.discard, say=say, after=draw, **cluster)
    return Runner(plan.runs, plan.records, options.worker_count, options.devices, options.discard, say, draw)


def list_plan(plan: StudyPlan, adopted: list[store.Record], say: Say) -> None:
    """List which runs are done and which are not, those `adopted` with the former."""
    there = [*store.load(plan.records), *adopted]
    done = [store.find(there, spec) is not None for spec in plan.wanted]
    for spec, is_done in zip(plan.wanted, done):
        how = f"{spec.train.iterations:,} iterations, {spec.data.resolution}, {spec.data.split}"
        say(f"{'done   ' if is_done else 'to run '} {spec.label}: {how}")
    say(f"{len(plan.wanted)} runs, {sum(done)} of them done")


def figure_drawer(options: ReproduceOptions, plan: StudyPlan) -> Callable[[Spec, Path], None]:
    """A function that draws Figure 5 from a run folder, if the figure is requested and the run
    belongs to it and has the first seed."""
    figure5 = set(EXPERIMENTS["fig5"].rows.values()) if any(e.name == "fig5" for e in plan.experiments) else set()

    def draw(spec: Spec, folder: Path) -> None:
        if spec.recipe in figure5 and spec.seed == min(options.seeds or (0,)):
            report.draw_experts(spec, folder, options.out)

    return draw


def run_plan(runner: Runner, plan: StudyPlan, out: Path) -> list[Failure]:
    """Train the missing runs and draw missing pictures of the finished ones into `out`; returns the
    runs that failed."""
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
