"""The commands, one function each: flags in, exit code out. The only place a device is chosen."""

from __future__ import annotations

import shlex
import signal
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import torch
import tyro
from rich.console import Console

from scene_experts import run_folder
from scene_experts import train as training
from scene_experts.cli import COMMANDS, PROG
from scene_experts.config import Data, RunConfig, Train, check, expect_at_least
from scene_experts.data.capture import Capture
from scene_experts.data.report import show
from scene_experts.errors import InputError
from scene_experts.progress import Progress
from scene_experts.recipes import RECIPES
from scene_experts.record import Recorder
from scene_experts.render import Rasterizer, choose
from scene_experts.train import Run

Device = Literal["auto", "cpu", "cuda"]
Raster = Literal["auto", "reference", "cpu", "gsplat"]

# --- info ---------------------------------------------------------------------------------------------------------------------------------


def info(args: list[str]) -> int:
    data = tyro.cli(
        Annotated[Data, tyro.conf.arg(name="")],
        prog=f"{PROG} info",
        args=positional(args, "--data"),
        description="Say what a capture holds.",
    )
    show(run_folder.load_capture(data), Console(highlight=False))
    return 0


# --- train --------------------------------------------------------------------------------------------------------------------------------


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
    tensorboard: bool = False
    """Write RUN/tensorboard too (pip install 'scene-experts[tensorboard]')."""


def train(args: list[str]) -> int:
    command = parse_train(args)
    check_settings(command)
    console = Console(highlight=False)
    device, rasterize = backend(command.device, command.rasterizer, command.cfg.antialias, command.deterministic)
    line = shlex.join([PROG, "train", *args])
    config = RunConfig(command.cfg, command.data, line, command.deterministic, command.stop_at, run_folder.versions())
    run_folder.check(command.out, config, command.resume, command.overwrite)
    capture = run_folder.load_capture(command.data, command.cfg.seed)
    for warning in capture.warnings:
        print(f"warning: {warning}", file=sys.stderr)
    run = Run(
        config=config,
        out=command.out,
        device=device,
        resume=command.resume,
        save_every=command.save_every,
        preview_every=command.preview_every,
        max_memory=command.max_memory,
    )
    what = f"{config.train.recipe} on {capture.name} ({len(capture.train)} views)"
    console.print(f"{what}, {device}, rasteriser {rasterize.name}", soft_wrap=True)
    return follow(command, run, capture, rasterize, console)


def parse_train(args: list[str]) -> TrainCommand:
    """The recipe and its flags. Every recipe is a subcommand whose defaults are its numbers."""
    if args and not args[0].startswith("-") and args[0] not in RECIPES:
        raise InputError(f"expected a recipe ({', '.join(RECIPES)}), found '{args[0]}'; see {PROG} train --help")
    chosen = {args[0]: RECIPES[args[0]]} if args and args[0] in RECIPES else RECIPES
    defaults = {
        name: (text, TrainCommand(data=Data(path=tyro.MISSING), out=tyro.MISSING, cfg=cfg))  # type: ignore[arg-type]
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
    return tyro.extras.overridable_config_cli(defaults, args=args, prog=f"{PROG} train")


def check_settings(command: TrainCommand) -> None:
    """Raises InputError for settings that no training can have."""
    stop_at = 1 if command.stop_at is None else command.stop_at
    numbers = [("--save-every", command.save_every, 1), ("--preview-every", command.preview_every, 0), ("--stop-at", stop_at, 1)]
    expect_at_least([*numbers, ("--max-memory", command.max_memory, 0)])
    check(command.cfg)


def follow(command: TrainCommand, run: Run, capture: Capture, rasterize: Rasterizer, console: Console) -> int:
    """Train, show and record; Ctrl-C and SIGTERM save and end the run."""

    def stop(number: int, _: object) -> None:
        if run.stop:
            raise KeyboardInterrupt  # a second signal does not wait
        run.stop.append(signal.Signals(number).name)

    previous = {s: signal.signal(s, stop) for s in (signal.SIGINT, signal.SIGTERM)}
    try:
        with Recorder(command.out, command.tensorboard, capture) as record, Progress(console) as progress:
            for event in training.train(command.cfg, run, capture, rasterize):
                if isinstance(event, training.Started):  # what can fail before the first iteration has not: now the folder may change
                    run_folder.prepare(command.out, run.config, command.resume, command.overwrite)
                record(event)
                progress(event)
    finally:
        for number, handler in previous.items():
            signal.signal(number, handler)
        capture.images.close()
    if not run.stop:
        from scene_experts.export.run import write_layout
        from scene_experts.run_folder import open_run

        folder = write_layout(open_run(command.out), capture)
        console.print(f"wrote {folder}", soft_wrap=True)
        console.print(f"next: {PROG} eval {command.out}", soft_wrap=True)
    return 0


# --- eval, compare ------------------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class EvalCommand:
    """Render the held-out views of a run to disk and score the 8-bit files."""

    run: Annotated[Path, tyro.conf.Positional]
    """Run folder."""
    data: Annotated[Path | None, tyro.conf.arg(aliases=["-s"])] = None
    """Where the capture is now, if it moved."""
    views: Literal["test", "train"] = "test"
    step: int | None = None
    """Checkpoint to score; the newest by default."""
    lpips: bool = True
    """Score LPIPS where its weights are found."""
    lpips_weights: Path | None = None
    """Folder or file with the LPIPS weights."""
    download_lpips: bool = False
    """Fetch the LPIPS weights if they are nowhere on this machine."""
    device: Device = "auto"
    rasterizer: Raster = "auto"


def evaluate(args: list[str]) -> int:
    from scene_experts.evaluate.command import evaluate_run
    from scene_experts.evaluate.tables import print_results

    command = tyro.cli(EvalCommand, prog=f"{PROG} eval", args=args)
    device, rasterize = backend(command.device, command.rasterizer, False, False)
    results = evaluate_run(
        command.run,
        device,
        rasterize,
        data=command.data,
        views=command.views,
        step=command.step,
        lpips=command.lpips,
        lpips_weights=command.lpips_weights,
        download=command.download_lpips,
    )
    print_results(results, Console(highlight=False), command.run)
    return 0


@dataclass(frozen=True)
class CompareCommand:
    """One table of several evaluated runs."""

    runs: Annotated[tuple[Path, ...], tyro.conf.Positional]
    """Run folders."""
    format: Literal["table", "markdown", "csv"] = "table"
    mixed: bool = False
    """Compare runs of different captures, resolutions or splits all the same."""


def compare(args: list[str]) -> int:
    from scene_experts.evaluate.tables import compare_runs

    command = tyro.cli(CompareCommand, prog=f"{PROG} compare", args=args)
    compare_runs(command.runs, command.format, command.mixed, Console(highlight=False))
    return 0


# --- files --------------------------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class ExportCommand:
    """Write a trained scene to a file other tools or later runs can read."""

    run: Annotated[Path, tyro.conf.Positional]
    """Run folder."""
    format: Literal["anchors", "compact"] = "compact"
    """anchors: the Scaffold-GS folder layout; compact: one small file of ours."""
    out: Path | None = None
    """File or folder to write; inside the run folder by default."""
    step: int | None = None
    measure: bool = True
    """Render the held-out views before and after, and say what a compact file costs in PSNR."""


def export(args: list[str]) -> int:
    from scene_experts.export.run import export_run

    command = tyro.cli(ExportCommand, prog=f"{PROG} export", args=args)
    rasterize = backend("cpu", "auto", False, False)[1] if command.measure else None
    for line in export_run(command.run, command.format, command.out, command.step, rasterize):
        print(line)
    return 0


@dataclass(frozen=True)
class ImportCommand:
    """Make a run folder of a published Scaffold-GS result folder or of one of our compact files, to evaluate and convert it."""

    source: Annotated[Path, tyro.conf.Positional]
    """Result folder (with point_cloud/iteration_N) or compact file."""
    data: Annotated[Data, tyro.conf.arg(name="")]
    out: Annotated[Path, tyro.conf.arg(aliases=["-m"])]
    """Run folder to write."""
    iteration: int | None = None


def import_(args: list[str]) -> int:
    from scene_experts.export.run import import_result

    command = tyro.cli(ImportCommand, prog=f"{PROG} import", args=args)
    print(f"wrote {import_result(command.source, command.data, command.out, command.iteration)}")
    return 0


def doctor(args: list[str]) -> int:
    from scene_experts import doctor as checks

    tyro.cli(lambda: None, prog=f"{PROG} doctor", args=args, description=COMMANDS["doctor"])
    return checks.run(Console(highlight=False))


# --- shared -------------------------------------------------------------------------------------------------------------------------------


def backend(device: Device, raster: Raster, antialias: bool, deterministic: bool) -> tuple[str, Rasterizer]:
    """The device and the rasteriser for it. Raises InputError when what was asked for is not there."""

    if device == "cuda" and not torch.cuda.is_available():
        raise InputError("expected a CUDA device, found none that torch can use; run `scene-experts doctor`, or use --device cpu")
    if device == "auto":
        device = "cuda" if torch.cuda.is_available() else "cpu"
    if deterministic:
        torch.use_deterministic_algorithms(True, warn_only=True)
    return device, choose(raster, device, antialias=antialias, deterministic=deterministic)


def positional(args: list[str], flag: str) -> list[str]:
    """Let the first argument stand for `flag`: `info CAPTURE` for `info --data CAPTURE`."""
    return [flag, *args] if args and not args[0].startswith("-") else args


HANDLERS: dict[str, Callable[[list[str]], int]] = {
    "info": info,
    "train": train,
    "eval": evaluate,
    "compare": compare,
    "export": export,
    "import": import_,
    "doctor": doctor,
}
