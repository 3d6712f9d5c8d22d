"""`scene-experts export` and `import`: runs to files, files to runs."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro

from scene_experts.cli import PROG
from scene_experts.commands.shared import backend
from scene_experts.config import Data
from scene_experts.run_folder import named


@dataclass(frozen=True)
class ExportCommand:
    """Write a trained scene to a file other tools or later runs can read."""

    run: Annotated[Path, tyro.conf.Positional]
    """Run folder."""
    format: Literal["anchors", "compact", "ply"] = "compact"
    """anchors: the Scaffold-GS folder layout; compact: one small file of ours; ply: explicit Gaussians as 3DGS's file."""
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
    """Make a run folder of a published Scaffold-GS or 3DGS result or of one of our compact files, to evaluate and convert it."""

    source: Annotated[Path, tyro.conf.Positional]
    """Result folder (with point_cloud/iteration_N), PLY file of 3DGS, or compact file."""
    data: Annotated[Data, tyro.conf.arg(name="")]
    out: Annotated[Path, tyro.conf.arg(aliases=["-m"])]
    """Run folder to write."""
    iteration: int | None = None


def import_(args: list[str]) -> int:
    from scene_experts.export.run import import_result

    command = tyro.cli(ImportCommand, prog=f"{PROG} import", args=args)
    print(f"wrote {import_result(command.source, named(command.data), command.out, command.iteration)}")
    return 0
