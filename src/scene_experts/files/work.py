"""What the writers of files share: the export of a run in one format, and what it wrote."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

from scene_experts.core.errors import InputError
from scene_experts.files.measure import Tell
from scene_experts.files.options import Options
from scene_experts.files.registry import Format, format_named, format_names
from scene_experts.render import Rasterizer
from scene_experts.training.run_folder import OpenRun

NAME = "scene"  # of files whose name the caller does not choose


@dataclass(frozen=True)
class Written:
    """What `export` wrote."""

    path: Path
    """The file, or the folder point_cloud/iteration_N of a result folder."""
    bytes: int
    """Size of the file, or of the folder's files."""
    rows: int
    """Anchors, Gaussians or points in it."""
    lines: tuple[str, ...]
    """The same in sentences, for a terminal."""
    psnr: dict[str, float] = field(default_factory=dict)
    """Mean PSNR of the held-out views against the photographs, dB, drawn from the "run" and from
    the "file", for a baked scene also from its "closed_form" and its "bake"; empty where nothing
    was measured."""


@dataclass(frozen=True)
class Work:
    """The export of one run in one format."""

    run: OpenRun
    name: str  # of the format
    format: Format
    options: Options
    rasterize: Rasterizer | None
    tell: Tell
    command: str

    @property
    def is_direct(self) -> bool:
        """Whether the run's rows are standard Gaussians already and are written as they are."""
        degree, how = self.run.scene.traits.sh_degree, self.options
        cut = 0 < how.max_gaussians < len(self.run.scene.table)
        return degree is not None and how.sh_degree >= degree and not how.prune and not cut


def file_path(run: Path, name: str, format: Format, out: Path | None) -> Path:
    """Where a file of a format goes: `out`, or scene.SUFFIX in the folder `out` or `run`.

    Raises InputError for a name with the suffix of another format: programs go by it.
    """
    if out is None or out.is_dir():
        return (out or run) / f"{NAME}{format.suffix}"
    suffixes = {other: format_named(other).suffix for other in format_names()}
    matching = {other: suffix for other, suffix in suffixes.items() if suffix and out.name.lower().endswith(suffix)}
    found = max(matching, key=lambda other: len(matching[other]), default=name)
    if found != name and matching[found] not in format.other_suffixes:
        raise InputError(f"expected a name that ends in {format.suffix} for --format {name}, found {out.name}; correct --out or --format")
    return out


def flag(name: str) -> str:
    """The option of the command line for a field of `Options`."""
    return "--" + name.replace("_", "-")
