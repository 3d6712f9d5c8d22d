"""`scene-experts report`: one page of a run, or of several beside each other."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from scene_experts.arguments.option import Option
from scene_experts.arguments.parse import Command, parse
from scene_experts.commands import PROG


@dataclass(frozen=True)
class ReportCommand:
    """Write one self-contained HTML page about evaluated runs: scores, curves, views with a slider,
    experts and commands."""

    runs: Annotated[tuple[Path, ...], Option(value="RUN")]
    """Run folders. Several runs are shown side by side."""
    out: Path | None = None
    """File to write; by default RUN/report.html for one run."""


def report(args: list[str]) -> int:
    command = parse(ReportCommand, Command(f"{PROG} report", ("runs",)), args)
    from scene_experts.report import page

    print(f"wrote {page.write(command.runs, command.out)}")
    return 0
