"""Files to runs: the only entry is `import_files`."""

from __future__ import annotations

from pathlib import Path

from scene_experts.core import checkpoint
from scene_experts.core.errors import InputError
from scene_experts.core.reading import budget
from scene_experts.core.reading.source import guarding
from scene_experts.data.settings import Data
from scene_experts.files.formats.ply import read_vertices
from scene_experts.files.registry import FAMILIES, Family, family_named, recognise, scene_file
from scene_experts.files.result_folder import is_result, iteration_folder
from scene_experts.files.scene_folder import write_result_folder
from scene_experts.scene.fit import restore_foreign
from scene_experts.training import run_folder
from scene_experts.training.config import RunConfig


def import_files(source: Path, data: Data, out: Path, iteration: int | None = None) -> Path:
    """Make a run folder of a published result folder, of one of ours, or of a file in any format
    that has a reader.

    source: result folder of Scaffold-GS, Octree-GS or 3DGS (with point_cloud/iteration_N), a folder
    of SOG (with meta.json), or a file that `export` writes. data: the capture that it belongs to; its frame and unit are those of
    the file.  out: new run folder. iteration: of a result folder; None: the newest. Where a lone
    file does not say how long it was trained, this number counts. Returns `out`, with
    configuration, checkpoint and result folder, ready for `eval`, `render` and `export`. Raises
    InputError for a source that cannot be read, a capture that does not fit, and an `out` that
    holds another run; RunError when the disk is full.
    """
    source = Path(source)
    if not source.exists():
        raise InputError(f"expected a result folder or a file of a scene at {source}, found nothing; check the path")
    family, found = owner(source, iteration)
    with guarding(found, budget.HEAD, "scene"):
        read = family.read(found, data, iteration)
        restore_foreign(read.cfg.scaled_scene(), read.tensors, {"step": read.step, **read.meta})  # before anything is written
    config = RunConfig(read.cfg, read.data, f"import {found.name if found.is_file() else source.name}", versions=run_folder.versions())
    run_folder.prepare(out, config, resume=False)
    meta = {"recipe": read.cfg.recipe, "step": read.step, "seconds": 0.0, **read.meta, "config": "imported"}
    checkpoint.save(out / "checkpoints", read.step, read.tensors, meta)
    write_result_folder(run_folder.open_run(out), read.capture)
    return out


def owner(source: Path, iteration: int | None) -> tuple[Family, Path]:
    """The family that reads `source`, and the file or folder that it reads. Raises InputError where
    no family does."""
    if not is_result(source):
        source = scene_file(source)
    if source.is_file():
        family = family_named(recognise(source)[1].family)
        assert family is not None
        return family, source
    if is_result(source):
        for name in FAMILIES:
            family = family_named(name)
            if family is not None and (found := family.find(source, iteration)) is not None:
                return family, found
    path = iteration_folder(source, iteration) / "point_cloud.ply"
    columns = ", ".join(list(read_vertices(path))[:8])
    raise InputError(f"expected anchors, Gaussians or graph points in {path}, found only {columns}; give another result")
