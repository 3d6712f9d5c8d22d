"""`scene-experts report`: one page of a run, or of several beside each other."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from scene_experts.cli import PROG
from scene_experts.report import page


@dataclass(frozen=True)
class ReportCommand:
    """Write one self-contained HTML page of evaluated runs: figures, curves, views with a slider, experts, commands."""

    runs: Annotated[tuple[Path, ...], tyro.conf.Positional]
    """Run folders; several are set beside each other."""
    out: Path | None = None
    """File to write; RUN/report.html by default for one run."""


def report(args: list[str]) -> int:
    command = tyro.cli(ReportCommand, prog=f"{PROG} report", args=args)
    print(f"wrote {page.write(command.runs, command.out)}")
    return 0
