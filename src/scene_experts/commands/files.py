"""`scene-experts export` and `import`: runs to files, files to runs."""

from __future__ import annotations

import shlex
from dataclasses import dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from scene_experts.arguments.option import Option
from scene_experts.arguments.parse import Command, parse
from scene_experts.commands import PROG
from scene_experts.core.errors import InputError
from scene_experts.data.settings import Data

if TYPE_CHECKING:
    from scene_experts.render import Rasterizer


@dataclass(frozen=True)
class ExportCommand:
    """Write a trained scene to a file other tools or later runs can read.

    Standard files (ply and what follows it) hold Gaussians that no network changes: scenes of anchors are baked for them, in minutes.
    """

    run: Annotated[Path, Option(value="RUN")]
    """Run folder."""
    format: Literal["anchors", "compact", "ply", "compressed-ply", "splat", "spz", "sog", "glb", "html"] = "compact"
    """anchors: the Scaffold-GS folder layout; compact: one small file of ours; the others are standard files that viewers open."""
    out: Path | None = None
    """File or folder to write; inside the run folder by default."""
    step: int | None = None
    measure: bool = True
    """Render the held-out views before and after, and say what the file costs in PSNR."""
    data: Annotated[Path | None, Option(short="-s", value="CAPTURE")] = None
    """Where the capture is now, if it moved. Standard files need it; for a compact file, what it costs in PSNR does."""
    sh_degree: int = 3
    """Standard files: degree of the harmonics, 0 (smallest) to 3 (best)."""
    max_gaussians: int = 0
    """Standard files: keep so many that contribute most; 0 keeps all."""
    prune: float = 0.0
    """Standard files: leave out those that contribute least, up to this share of everything that all contribute (0.02: small loss)."""
    refine: int = 1000
    """Standard files: iterations that move all parameters towards the run's pictures; 0 takes means over the views as they are."""
    frame: Literal["capture", "trained"] = "capture"
    """Standard files: the capture's own frame, or the one that it was trained in."""
    levels: bool = False
    """Standard files: one for each level of detail, each without the finer ones."""


def export(args: list[str]) -> int:
    command = parse(ExportCommand, Command(f"{PROG} export", ("--run",)), args)

    from scene_experts.api.backend import backend
    from scene_experts.files.export import export_run
    from scene_experts.training.memory import reuse_freed

    rasterize = backend("cpu", "auto", False, False)[1]
    reuse_freed()
    if command.format in ("anchors", "compact"):
        check_unused(command)
        lines = export_run(command.run, command.format, command.out, command.step, rasterize if command.measure else None, command.data)
    else:
        lines = _standard(command, args, rasterize)
    for line in lines:
        print(line)
    return 0


def check_unused(command: ExportCommand) -> None:
    """Raises InputError for settings of standard files where none is written."""
    standard = ("sh_degree", "max_gaussians", "prune", "refine", "frame", "levels")
    given = [f.name for f in fields(command) if f.name in standard and getattr(command, f.name) != f.default]
    if given:
        flag = "--" + given[0].replace("_", "-")
        raise InputError(f"expected {flag} with a standard file (ply, spz, html ...), found --format {command.format}; leave it out")


def _standard(command: ExportCommand, args: list[str], rasterize: Rasterizer) -> list[str]:
    from rich.console import Console

    from scene_experts.files.bake.bake import Bake
    from scene_experts.files.bake.export import Options, export_standard
    from scene_experts.files.bake.refine import Refine
    from scene_experts.training.progress import ProgressBar

    how = Bake(command.sh_degree, command.max_gaussians, command.prune, Refine(command.refine))
    options = Options(how, command.frame, command.levels, command.measure, shlex.join([PROG, "export", *args]))
    with ProgressBar(Console(stderr=True)) as tell:
        return export_standard(command.run, command.format, command.out, command.step, rasterize, options, command.data, tell)


@dataclass(frozen=True)
class ImportCommand:
    """Make a run folder of a published Scaffold-GS, Octree-GS or 3DGS result or of a file that `export` writes, to score and convert it."""

    source: Annotated[Path, Option(value="RESULT")]
    """Result folder (with point_cloud/iteration_N), compact file, or Gaussians as ply, compressed-ply, splat, spz, sog, glb or html."""
    data: Annotated[Data, Option(name="")]
    out: Annotated[Path, Option(short="-m", value="RUN")]
    """Run folder to write."""
    iteration: int | None = None


def import_(args: list[str]) -> int:
    command = parse(ImportCommand, Command(f"{PROG} import", ("--source",)), args)

    from scene_experts.files.export import import_result
    from scene_experts.training.run_folder import named

    print(f"wrote {import_result(command.source, named(command.data), command.out, command.iteration)}")
    print(f"next: {shlex.join([PROG, 'eval', str(command.out)])}")
    return 0
