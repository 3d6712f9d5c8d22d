"""`scene-experts train`: reads the options, trains and shows the events on the terminal."""

from __future__ import annotations

import re
import shlex
import signal
import sys
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

from rich.console import Console

from scene_experts.api import recording
from scene_experts.api.backend import backend, device_of
from scene_experts.arguments.help import columns
from scene_experts.arguments.option import Option
from scene_experts.arguments.parse import HELP, HELP_ALL, Command, HelpAsked, parse
from scene_experts.arguments.table import rows
from scene_experts.commands import PROG
from scene_experts.core.console import LastingConsole
from scene_experts.core.errors import InputError, few, nearest
from scene_experts.core.group import Alone, join
from scene_experts.core.signals import handled
from scene_experts.data import capture as captures
from scene_experts.data.capture import Capture
from scene_experts.data.fetch.catalog import defaults_in
from scene_experts.data.settings import Data
from scene_experts.render import Rasterizer
from scene_experts.sfm.drift import warn_of_steady
from scene_experts.training import run_folder
from scene_experts.training.background import with_background
from scene_experts.training.batch import check_batch
from scene_experts.training.config import RunConfig, Train, with_numbers
from scene_experts.training.events import Exported, Finished, Stopped
from scene_experts.training.job import Job
from scene_experts.training.memory import reuse_freed
from scene_experts.training.nearest import with_near_plane
from scene_experts.training.options import TrainOptions
from scene_experts.training.progress import TrainingProgress
from scene_experts.training.recipes import RECIPES
from scene_experts.training.shards import check_shard
from scene_experts.view.live import Live
from scene_experts.view.server import check_port, import_viser

FIRST = (
    "data",
    "out",
    "resolution",
    "iterations",
    "max-anchors",
    "max-memory",
    "seed",
    "device",
    "preview-every",
    "viewer",
    "resume",
    "overwrite",
)
"""The options that people use first, for --help."""

OTHERS = "Other recipes"
GROUPS = {
    "Methods": "one-network|scene-experts|scaffold-gs|moe-gs|3dgs|3dgs-mcmc|octree-gs|octree-moe-gs|sags",
    "Controls of scene-experts": "scene-experts-.*",
    "Variants of MoE-GS": "moe-gs-(?!e[2-5]-(top|dense)).*",
    "MoE-GS with other numbers of experts (Figure 6)": "moe-gs-e[2-5]-(top[12]|dense)",
    "Variants of Scaffold-GS": "scaffold-gs-(?!depth).*",
    "Scaffold-GS with deeper networks (Figure 7)": "scaffold-gs-depth.*",
    OTHERS: ".*",
}
"""Headings of the recipes in the help, each with a pattern of the recipes' names; the first that
fits counts."""

EXAMPLES = (
    "scaffold-gs --data demo/buddha --out runs/buddha",
    "scene-experts --data CAPTURE --out RUN --iterations 7000",
    "scaffold-gs --data CAPTURE --out RUN --resume",
    "moe-gs --data catalog:bonsai --out RUN",
)


@dataclass(frozen=True)
class TrainCommand:
    """The run."""

    data: Annotated[Data, Option(name="")]
    out: Annotated[Path, Option(short="-m", value="RUN")]
    """Run folder to write."""
    cfg: Annotated[Train, Option(name="")]
    options: Annotated[TrainOptions, Option(name="")] = TrainOptions()
    init_from: Annotated[Path | None, Option(value="RUN")] = None
    """Start from the scene of this run, at its iteration; --iterations counts its iterations too.
    The optimiser starts anew."""
    shard: bool = False
    """Divide the anchors among the processes of torchrun, so that each needs less memory. The
    results are those without it, up to rounding (docs/scaling.md)."""
    viewer: bool = False
    """Show the training in a browser while it runs (needs `pip install viser`)."""
    port: int = 8080
    """Port of the viewer. It only accepts connections from this machine."""


def train(args: list[str]) -> int:
    command = parse_train(args)
    group = join(device_of(command.options.device))
    command = after_restart(replace(command, viewer=command.viewer and group.first), group)
    line = shlex.join([PROG, "train", *(arg for arg in args if arg != "--resume")])  # the command of the whole run
    command, run, capture, rasterize = group.agree(lambda: prepare(command, line, group))
    console = LastingConsole(markup=False, highlight=False, quiet=not group.first)
    steady = warn_of_steady(capture.root) if command.cfg.exposure else None
    for warning in (*capture.warnings, *([steady] if steady else [])) if group.first else ():
        print(f"warning: {warning}", file=sys.stderr)
    what = f"{command.cfg.recipe} on {capture.name} ({len(capture.train)} training views, {len(capture.test)} held out)"
    together = f", {group.size} processes" if group.size > 1 else ""
    console.print(f"{what}, {run.device}, rasteriser {rasterize.name}{together}", soft_wrap=True)
    if run.config.data.background != command.data.background:
        colour = " ".join(f"{value:g}" for value in capture.background)
        console.print(f"background: the photographs' mean colour, {colour} (choose another with --background)", soft_wrap=True)
    if run.config.data.near != command.data.near:
        console.print(f"near plane: {run.config.data.near:g}, by what the photographs show (choose another with --near)", soft_wrap=True)
    code = follow(command, run, capture, rasterize, console)
    group.leave()
    return code


def after_restart(command: TrainCommand, group: Alone) -> TrainCommand:
    """Let a command that `torchrun` has restarted continue its run, if the run had begun."""
    begun = group.restarts > 0 and (command.out / "config.json").is_file()
    return replace(command, options=replace(command.options, resume=True, overwrite=False)) if begun else command


def prepare(command: TrainCommand, line: str, group: Alone) -> tuple[TrainCommand, Job, Capture, Rasterizer]:
    """Check the options and load the capture. Nothing is written. Raises InputError for invalid
    options or an invalid capture."""
    if command.viewer:
        check_port(command.port)
        import_viser()  # reports a missing package before anything is read
    command = replace(command, data=run_folder.named(command.data))
    run = replace(run_of(command, line), group=group)
    recording.check_settings(run)
    check_batch(command.cfg.batch, group.size)
    if command.shard:
        check_shard(command.cfg, command.options.max_memory, command.viewer)
    reuse_freed()
    options = command.options
    device, rasterize = group.in_turn(
        lambda: backend(options.device, options.rasterizer, command.cfg.antialias, options.deterministic),
    )
    run_folder.check(command.out, run.config, options.resume, options.overwrite)
    begun = run_folder.as_begun(command.out, run.config) if options.resume else run.config
    config, capture = with_near_plane(*with_background(begun, captures.load(begun.data, command.cfg.seed)))
    return command, replace(run, config=config, device=device), capture, rasterize


def run_of(command: TrainCommand, line: str) -> Job:
    """What the loop needs to know of the command, on the CPU. line: the command line, for
    config.json."""
    start = None if command.init_from is None else command.init_from.absolute()
    config = RunConfig.of(command.cfg, command.data, command.options, line, run_folder.versions(), start)
    return Job(config, command.out, options=command.options, shard=command.shard)


def parse_train(args: list[str]) -> TrainCommand:
    """The recipe and its options. The numbers of the recipe are the defaults. Raises InputError, or
    HelpAsked for --help."""
    name = args[0] if args else ""
    if name not in RECIPES:
        if name in RECIPES.broken:
            raise InputError(f"expected a recipe '{name}' that loads, found an error in it: {RECIPES.broken[name]}; correct the package")
        if any(arg in (*HELP, HELP_ALL) for arg in args):
            raise HelpAsked(help_of_recipes(HELP_ALL in args))
        raise InputError(no_recipe(args))
    text, cfg = RECIPES[name]
    brought = defaults_in(args)  # a scene of the catalog brings its units and numbers; options have the last word
    command = Command(
        f"{PROG} train {name}",
        first=FIRST,
        about=f"{text}.",
        defaults={"data.normalise": brought.normalise, "cfg": with_numbers(cfg, brought.numbers)},
        elsewhere=other_recipes,
    )
    return parse(TrainCommand, command, args[1:])


def no_recipe(args: list[str]) -> str:
    """What to say where the first word is no recipe."""
    name = args[0] if args else ""
    if name and not name.startswith("-"):
        return f"expected a recipe, found '{name}'{nearest(name, RECIPES) or f'; `{PROG} train --help` lists them'}"
    like = next((arg for arg in args if arg in RECIPES), "scaffold-gs")
    rest = "..." if args else "--data CAPTURE --out RUN"
    return f"expected a recipe after `{PROG} train`, found {name or 'none'}; write for example {PROG} train {like} {rest}"


def other_recipes(flag: str) -> str:
    """Which recipes have an option that the chosen one does not have."""
    found = [name for name, (_, cfg) in RECIPES.items() if any(flag in row.names for row in rows(TrainCommand, {"cfg": cfg}))]
    return f"this recipe does not have it ({few(found)} {'has' if len(found) == 1 else 'have'} it)" if found else ""


def help_of_recipes(everything: bool) -> str:
    """The help without a recipe: the methods and recipes of other packages, with `everything` also
    the controls and the variants of the papers, and examples."""
    left = dict(RECIPES)
    parts = [
        f"usage: {PROG} train RECIPE --data CAPTURE --out RUN [options]",
        "Train a scene on a capture. A recipe is a method with its numbers.",
    ]
    for title, pattern in GROUPS.items():
        if len(parts) > 2 and not everything and title != OTHERS:
            left = {name: text for name, text in left.items() if not re.fullmatch(pattern, name)}
            continue
        names = [name for name in left if re.fullmatch(pattern, name)]
        lines = [line for name in names for line in columns(f"  {name}", left.pop(name)[0])]
        parts += ["\n".join([f"{title}:", *lines])] if names else []
    parts.append("\n".join(["Examples:", *(f"  {PROG} train {example}" for example in EXAMPLES)]))
    asks = [] if everything else [f"`{PROG} train --help-all` also lists controls and variants of the papers."]
    return "\n\n".join([*parts, "\n".join([*asks, f"`{PROG} train RECIPE --help` shows the options of a recipe."])])


def follow(command: TrainCommand, run: Job, capture: Capture, rasterize: Rasterizer, console: Console) -> int:
    """Train and show the events; Ctrl-C, SIGTERM and a closed terminal save and end the run."""

    def stop(number: int, _: object) -> None:
        if run.stop:
            raise KeyboardInterrupt  # a second signal does not wait
        run.stop.append(signal.Signals(number).name)

    live, exported, stopped, reached = None, False, False, 0
    if command.viewer:
        say = lambda url: console.print(f"viewer: {url}", soft_wrap=True)  # noqa: E731
        label = f"{command.cfg.recipe} on {capture.name}"
        live = Live(capture, rasterize, lambda: bool(run.stop), command.port, label, command.out / "paths", say)
        run = replace(run, watch=live)
    with handled(stop), TrainingProgress(console, out=command.out) as progress:
        try:
            for event in recording.train(run, capture, rasterize):
                progress(event)
                stopped = stopped or isinstance(event, Stopped)
                if isinstance(event, Finished):
                    reached = event.step
                if isinstance(event, Exported):
                    exported = True
                    for warning in event.warnings:
                        print(warning, file=sys.stderr)
                if live:
                    live.follow(event)
        finally:
            if live:
                live.close()
            capture.images.close()
    if stopped:
        return 128 + signal.Signals[run.stop[0]]  # saved, but incomplete: `train && eval` must not go on
    if exported:
        console.print(f"next: {shlex.join([PROG, 'eval', str(command.out)])}", soft_wrap=True)
    else:
        asked, whole = command.options.stop_at or 0, command.cfg.iterations
        if reached < whole:
            text = f"the training was already at iteration {reached:,} of {whole:,}; the files of the run are unchanged"
            console.print(f"{text}; to go on, give a larger --stop-at than {asked:,} or none", soft_wrap=True)
            return 0
        longer = f"; --stop-at {asked:,} is beyond the {whole:,} iterations of its schedule" if asked > whole else ""
        go_on = f"; for more, train into another --out with --init-from {command.out} and more --iterations"
        console.print(f"the training was already complete; the files of the run are unchanged{longer}{go_on}", soft_wrap=True)
    return 0
