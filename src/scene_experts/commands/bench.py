"""`bench`: what this machine makes of the package."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from scene_experts.arguments.parse import Command, parse
from scene_experts.commands import PROG


@dataclass(frozen=True)
class BenchCommand:
    """Print this machine's figures: rasteriser, decode, loss, a whole training step and the gain of threads, each beside a named peer."""

    seconds: float = 60.0
    """How long to measure, about. Below 30 the measured scenes are smaller."""
    threads: int | None = None
    """Threads whose gain over one is measured; torch's own setting by default."""
    json: Path | None = None
    """File to write the figures to, too."""


def bench(args: list[str]) -> int:
    """`scene-experts bench`."""
    command = parse(BenchCommand, Command(f"{PROG} bench"), args)
    from rich.console import Console

    from scene_experts.bench.table import run

    return run(command.seconds, command.threads, command.json, Console(highlight=False))
