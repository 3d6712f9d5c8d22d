"""`bench`: what this machine makes of the package."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from scene_experts.arguments.parse import Command, parse
from scene_experts.commands import PROG


@dataclass(frozen=True)
class BenchCommand:
    """Measure the speed of this machine: rasteriser, decoding, loss, a training step and
    multithreading, each next to a named peer."""

    seconds: float = 60.0
    """Approximate duration in seconds. Below 30, smaller scenes are measured."""
    threads: int | None = None
    """Number of threads to compare with one thread, at most four times the cores; by default
    PyTorch's setting."""
    json: Path | None = None
    """Also write the measurements to this file."""


def bench(args: list[str]) -> int:
    """`scene-experts bench`."""
    command = parse(BenchCommand, Command(f"{PROG} bench"), args)
    from rich.console import Console

    from scene_experts.bench.table import run

    return run(command.seconds, command.threads, command.json, Console(highlight=False))
