"""`scene-experts eval` and `compare`: scores of runs."""

from __future__ import annotations

import shlex
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

from scene_experts.arguments.option import Option
from scene_experts.arguments.parse import Command, parse
from scene_experts.commands import PROG
from scene_experts.core.choices import Device, Raster
from scene_experts.evaluate.options import EvalOptions


@dataclass(frozen=True)
class EvalCommand:
    """Render the held-out views of a run, save them as 8-bit pictures and score these.

    Writes RUN/results.json, RUN/per_view.json, RUN/training_views.json, the pictures in RUN/test and
    RUN/training_views, and RUN/report.html.
    """

    run: Annotated[Path, Option(value="RUN")]
    """Run folder."""
    options: Annotated[EvalOptions, Option(name="")] = EvalOptions()
    data: Annotated[Path | None, Option(short="-s", value="CAPTURE")] = None
    """Folder of the capture, if it has moved."""
    step: int | None = None
    """Iteration of the checkpoint to score; by default the newest."""
    device: Device = "auto"
    """Device to render on. auto: CUDA if available."""
    rasterizer: Raster = "auto"
    """Rasteriser. auto: the fastest that works on the device."""


def evaluate(args: list[str]) -> int:
    command = parse(EvalCommand, Command(f"{PROG} eval", ("run",)), args)

    from rich.console import Console

    from scene_experts.api.backend import backend, device_of
    from scene_experts.core.group import join
    from scene_experts.evaluate.command import evaluate_run
    from scene_experts.evaluate.photographs import describe_outliers, read_photographs
    from scene_experts.evaluate.tables import print_results
    from scene_experts.report import page
    from scene_experts.training import run_folder

    group = join(device_of(command.device))
    device, rasterize = group.in_turn(lambda: backend(command.device, command.rasterizer, False, False))
    results = evaluate_run(command.run, device, rasterize, command.options, data=command.data, step=command.step, group=group)
    group.leave()
    if not group.first:
        return 0
    print_results(results, Console(markup=False, highlight=False), command.run)
    if (aligned := results.get("psnr_aligned")) is not None and aligned - results["psnr"] >= DRIFTS:
        why = "" if run_folder.read_config(command.run).train.exposure else ": exposures may differ (train --exposure)"
        print(f"PSNR {aligned:.2f} dB with the colours of each picture aligned with its photograph{why}")
    if not command.options.suffix:  # the page shows the held-out views, and all photographs
        for line in describe_outliers(read_photographs(command.run)):
            print(f"warning: {line}")
        print(f"wrote {page.write([command.run])}, with the pictures and what each score means")
    if command.options == EvalOptions():
        place, moved = str(command.run / "scene.html"), ["--data", str(command.data)] if command.data else []
        words = [PROG, "export", str(command.run), "--format", "html", "--title", results["capture"], *moved, "--out", place]
        print(f"next: {shlex.join(words)}  # or --format ply")
        print(f"next: {shlex.join([PROG, 'render', str(command.run), *moved, '--out', str(command.run / 'flight.mp4')])}")
    return 0


DRIFTS = 1.0
"""dB that the alignment of colours gains where `eval` tells it."""


@dataclass(frozen=True)
class CompareCommand:
    """Show the scores of several evaluated runs in one table."""

    runs: Annotated[tuple[Path, ...], Option(value="RUN")]
    """Run folders, evaluated with `eval`."""
    format: Literal["table", "markdown", "csv"] = "table"
    """Format of the table."""
    mixed: bool = False
    """Allow runs of different captures, resolutions or splits in one table."""


def compare(args: list[str]) -> int:
    command = parse(CompareCommand, Command(f"{PROG} compare", ("runs",)), args)

    from rich.console import Console

    from scene_experts.evaluate.tables import compare_runs

    compare_runs(command.runs, command.format, command.mixed, Console(markup=False, highlight=False))
    return 0
