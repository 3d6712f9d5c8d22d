"""`scene-experts eval` and `compare`: scores of runs."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

from rich.console import Console

from scene_experts.arguments.option import Option
from scene_experts.arguments.parse import Command, parse
from scene_experts.commands import PROG
from scene_experts.commands.shared import Device, Raster, backend


@dataclass(frozen=True)
class EvalCommand:
    """Render the held-out views of a run to disk and score the 8-bit files."""

    run: Annotated[Path, Option(value="RUN")]
    """Run folder."""
    data: Annotated[Path | None, Option(short="-s", value="CAPTURE")] = None
    """Where the capture is now, if it moved."""
    views: Literal["test", "train"] = "test"
    appearance: Literal["rule", "half"] = "rule"
    """Appearance codes of held-out views: as the recipe's rule has it, or found on the left half of each photograph, whose right half is
    then scored (NeRF in the Wild's protocol; written beside the other results)."""
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
    from scene_experts.report import page

    command = parse(EvalCommand, Command(f"{PROG} eval", ("--run",)), args)
    device, rasterize = backend(command.device, command.rasterizer, False, False)
    results = evaluate_run(
        command.run,
        device,
        rasterize,
        data=command.data,
        views=command.views,
        appearance=command.appearance,
        step=command.step,
        lpips=command.lpips,
        lpips_weights=command.lpips_weights,
        download=command.download_lpips,
    )
    print_results(results, Console(highlight=False), command.run)
    if command.views == "test" and command.appearance == "rule":
        print(f"wrote {page.write([command.run])}")
    return 0


@dataclass(frozen=True)
class CompareCommand:
    """One table of several evaluated runs."""

    runs: Annotated[tuple[Path, ...], Option(value="RUN")]
    """Run folders."""
    format: Literal["table", "markdown", "csv"] = "table"
    mixed: bool = False
    """Compare runs of different captures, resolutions or splits all the same."""


def compare(args: list[str]) -> int:
    from scene_experts.evaluate.tables import compare_runs

    command = parse(CompareCommand, Command(f"{PROG} compare", ("--runs",)), args)
    compare_runs(command.runs, command.format, command.mixed, Console(highlight=False))
    return 0
