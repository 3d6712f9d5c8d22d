"""Files to runs: the only entry is `import_files`."""

from __future__ import annotations

import logging
from pathlib import Path

import torch

from scene_experts.core import checkpoint
from scene_experts.core.errors import InputError
from scene_experts.core.reading import budget
from scene_experts.core.reading.source import guarding
from scene_experts.data.settings import Data
from scene_experts.data.views import Capture
from scene_experts.evaluate.metrics import psnr
from scene_experts.files.formats.ply import read_vertices
from scene_experts.files.gaussians.read import read as read_gaussians
from scene_experts.files.measure import Painter
from scene_experts.files.registry import FAMILIES, GAUSSIANS, Family, family_named, recognise, scene_file
from scene_experts.files.result_folder import is_result, iteration_folder
from scene_experts.files.scene_folder import write_result_folder
from scene_experts.scene.fit import restore_foreign
from scene_experts.training import run_folder
from scene_experts.training.config import RunConfig
from scene_experts.training.run_folder import OpenRun

log: logging.Logger = logging.getLogger(__name__)
LOOKED_AT = 3  # training views that an imported scene is compared with


def import_files(source: Path, data: Data, out: Path, iteration: int | None = None, transform: Path | None = None) -> Path:
    """Make a run folder of a published result folder, of one of ours, or of a file in any format
    that has a reader.

    source: result folder of Scaffold-GS, Octree-GS or 3DGS (with point_cloud/iteration_N), a folder
    of SOG (with meta.json), or a file that `export` writes. data: the capture that it belongs to; its
    frame and unit are those of the file unless `transform` (`transform.read_transform`) says
    otherwise. out: new run folder. iteration: of a result folder; None: the newest. Where a lone
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
        if transform is not None:
            if family is not family_named(GAUSSIANS):
                raise InputError(f"expected plain Gaussians for --transform, found anchors or graph points in {found}; leave it out")
            read = read_gaussians(found, data, iteration, transform)
        else:
            read = family.read(found, data, iteration)
        restore_foreign(read.cfg.scaled_scene(), read.tensors, {"step": read.step, **read.meta})  # before anything is written
    config = RunConfig(read.cfg, read.data, f"import {found.name if found.is_file() else source.name}", versions=run_folder.versions())
    run_folder.prepare(out, config, resume=False)
    meta = {"recipe": read.cfg.recipe, "step": read.step, "seconds": 0.0, **read.meta, "config": "imported"}
    checkpoint.save(out / "checkpoints", read.step, read.tensors, meta)
    run = run_folder.open_run(out)
    write_result_folder(run, read.capture)
    if (told := compare_with_photographs(run, read.capture)) is not None:
        log.warning("%s %s", source, told)
    return out


@torch.no_grad()
def compare_with_photographs(run: OpenRun, capture: Capture) -> str | None:
    """Return what a user should know where the scene shows nothing of the photographs: its pictures
    of all of up to three training views are no nearer to the photographs than their mean
    colours."""
    painter = Painter.of(run.scene, run.step, None, run.config.train.antialias)
    background = torch.tensor(capture.background)
    ours, plain = list[float](), list[float]()
    for index in capture.train[:: max(1, -(-len(capture.train) // LOOKED_AT))]:
        try:
            frame = capture.frame(index)
        except InputError:  # a scene can be imported beside a damaged photograph
            continue
        photograph = frame.rgb.float() / 255
        ours.append(psnr(painter.picture_8bit(capture.views[index].camera, background), photograph, frame.mask))
        plain.append(psnr(photograph.mean((0, 1)).expand_as(photograph), photograph, frame.mask))
    capture.images.close()
    if not ours or any(a > b for a, b in zip(ours, plain)):
        return None
    return (
        f"shows nothing of the photographs ({sum(ours) / len(ours):.1f} dB in {len(ours)} training views, their mean colours have "
        f"{sum(plain) / len(plain):.1f} dB): it is probably in another frame than the capture; if nerfstudio made it, give "
        "--transform dataparser_transforms.json"
    )


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
