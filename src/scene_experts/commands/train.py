"""`scene-experts train`: flags to a training, its events to the terminal and the run folder."""

from __future__ import annotations

import shlex
import signal
import sys
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Annotated

import tyro
from rich.console import Console

from scene_experts.api import recording
from scene_experts.cli import PROG
from scene_experts.commands.shared import Device, Raster, backend
from scene_experts.core.errors import InputError, nearest
from scene_experts.core.signals import handled
from scene_experts.data.capture import Capture
from scene_experts.data.fetch.catalog import PREFIX, Numbers, one
from scene_experts.recipes import RECIPES
from scene_experts.render import Rasterizer
from scene_experts.training import run_folder
from scene_experts.training.config import Data, RunConfig, Train, with_numbers
from scene_experts.training.events import Exported
from scene_experts.training.loop import Run
from scene_experts.training.memory import reuse_freed
from scene_experts.training.progress import Progress
from scene_experts.view.live import Live
from scene_experts.view.server import check_port, viser


@dataclass(frozen=True)
class TrainCommand:
    """Train a scene."""

    data: Annotated[Data, tyro.conf.arg(name="")]
    out: Annotated[Path, tyro.conf.arg(aliases=["-m"])]
    """Run folder to write."""
    cfg: Annotated[Train, tyro.conf.arg(name="")]
    overwrite: bool = False
    """Begin anew in a run folder that holds an earlier run, whose checkpoints are removed."""
    resume: bool = False
    """Go on from the run's newest whole checkpoint."""
    stop_at: int | None = None
    """Stop at this iteration of the unchanged schedule (--iterations rescales it instead)."""
    deterministic: bool = False
    """Bit-identical results on one machine, resumed or not; a little slower."""
    device: Device = "auto"
    rasterizer: Raster = "auto"
    save_every: int = 5000
    """Iterations between checkpoints."""
    preview_every: int = 1000
    """Iterations between pictures of a held-out view in RUN/previews; 0 for none."""
    max_memory: float = 0.0
    """GiB of resident memory at which growth stops; 0 for no cap."""
    viewer: bool = False
    """Show the training in a browser while it runs (pip install 'scene-experts[viewer]')."""
    port: int = 8080
    """Port of the viewer, on this machine alone."""
    tensorboard: bool = False
    """Write RUN/tensorboard too (pip install 'scene-experts[tensorboard]')."""


def train(args: list[str]) -> int:
    command = parse_train(args)
    if command.viewer:
        check_port(command.port)
        viser()  # reports a missing package before anything is read
    command = replace(command, data=run_folder.named(command.data))
    line = shlex.join([PROG, "train", *(arg for arg in args if arg != "--resume")])  # the command that makes the whole run
    run = run_of(command, line)
    recording.check_settings(run)
    reuse_freed()
    console = Console(highlight=False)
    device, rasterize = backend(command.device, command.rasterizer, command.cfg.antialias, command.deterministic)
    run_folder.check(command.out, run.config, command.resume, command.overwrite)
    capture = run_folder.load_capture(command.data, command.cfg.seed)
    for warning in capture.warnings:
        print(f"warning: {warning}", file=sys.stderr)
    what = f"{command.cfg.recipe} on {capture.name} ({len(capture.train)} views)"
    console.print(f"{what}, {device}, rasteriser {rasterize.name}", soft_wrap=True)
    return follow(command, replace(run, device=device), capture, rasterize, console)


def run_of(command: TrainCommand, line: str) -> Run:
    """What the loop needs to know of the command, on the CPU. line: the command line, for config.json."""
    return Run(
        config=RunConfig(command.cfg, command.data, line, command.deterministic, command.stop_at, run_folder.versions()),
        out=command.out,
        resume=command.resume,
        save_every=command.save_every,
        preview_every=command.preview_every,
        max_memory=command.max_memory,
    )


def parse_train(args: list[str]) -> TrainCommand:
    """The recipe and its flags. Every recipe is a subcommand whose defaults are its numbers."""
    if args and not args[0].startswith("-") and args[0] not in RECIPES:
        raise InputError(
            f"expected a recipe, found '{args[0]}'{nearest(args[0], RECIPES)}; there are {', '.join(RECIPES)}; see {PROG} train --help"
        )
    chosen = {args[0]: RECIPES[args[0]]} if args and args[0] in RECIPES else RECIPES
    data, numbers = of_the_catalog(args)
    defaults = {
        name: (text, TrainCommand(data=data, out=tyro.MISSING, cfg=with_numbers(cfg, numbers)))  # type: ignore[arg-type]
        for name, (text, cfg) in chosen.items()
    }
    if len(defaults) == 1:
        ((name, (text, default)),) = defaults.items()
        return tyro.cli(
            TrainCommand,
            default=default,
            args=args[1:],
            prog=f"{PROG} train {name}",
            description=text,
            config=(tyro.conf.AvoidSubcommands,),
        )
    return tyro.extras.overridable_config_cli(defaults, args=args, prog=f"{PROG} train", description=flags_of_all())


def of_the_catalog(args: list[str]) -> tuple[Data, Numbers]:
    """The defaults that a scene of the paper brings (its own units, its data set's numbers); flags have the last word."""
    named = next((word for arg in args if (word := arg.removeprefix("--data=")).startswith(PREFIX)), None)
    if named is None:
        return Data(path=tyro.MISSING), ()  # type: ignore[arg-type]
    return Data(path=tyro.MISSING, normalise="none"), one(named).collection.numbers  # type: ignore[arg-type]


def flags_of_all() -> str:
    """For the help without a recipe: the flags that every recipe takes."""
    parts = {"path", "cfg", "scene", "loss", "growth", "rates", "recipe", "schedule"}  # set by the recipe, or by flags of their own
    names = {f.name for part in (Data, Train, TrainCommand) for f in fields(part)} - parts
    own = sorted(f"--{name.replace('_', '-')}" for name in names)
    return (
        f"Train a scene: {PROG} train RECIPE --data CAPTURE --out RUN. Every recipe takes {', '.join(own)}, and the numbers of its "
        f"parts (--scene..., --loss..., --growth..., --rates...): {PROG} train RECIPE --help says them all."
    )


def follow(command: TrainCommand, run: Run, capture: Capture, rasterize: Rasterizer, console: Console) -> int:
    """Train and show the events; Ctrl-C, SIGTERM and a closed terminal save and end the run."""

    def stop(number: int, _: object) -> None:
        if run.stop:
            raise KeyboardInterrupt  # a second signal does not wait
        run.stop.append(signal.Signals(number).name)

    live, exported = None, False
    if command.viewer:
        say = lambda url: console.print(f"viewer: {url}", soft_wrap=True)  # noqa: E731
        label = f"{command.cfg.recipe} on {capture.name}"
        live = Live(capture, rasterize, lambda: bool(run.stop), command.port, label, command.out / "paths", say)
        run = replace(run, watch=live)
    with handled(stop), Progress(console) as progress:
        try:
            for event in recording.train(run, capture, rasterize, overwrite=command.overwrite, tensorboard=command.tensorboard):
                progress(event)
                if isinstance(event, Exported):
                    exported = True
                    for warning in event.warnings:
                        print(warning, file=sys.stderr)
                if live:
                    live.event(event)
        finally:
            if live:
                live.close()
            capture.images.close()
    if run.stop:
        return 128 + signal.Signals[run.stop[0]]  # saved, but incomplete: `train && eval` must not go on
    if exported:
        console.print(f"next: {shlex.join([PROG, 'eval', str(command.out)])}", soft_wrap=True)
    else:
        console.print("nothing was left to train: the run's files stay as they are", soft_wrap=True)
    return 0
