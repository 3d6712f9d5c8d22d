"""Scenes of explicit Gaussians as 3DGS's files, both ways: point_cloud/iteration_<N>/point_cloud.ply, in the capture's own frame.

The way in takes a file in any format of `standard.FORMATS`.

From the trained world to the capture's frame lengths scale and positions move; axes are kept, so rotations and harmonics stay as they are.
"""

from __future__ import annotations

import logging
import math
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

from torch import Tensor

from scene_experts.core import checkpoint
from scene_experts.core.errors import InputError
from scene_experts.core.io import read_json, write_bytes, write_json
from scene_experts.data.views import Capture, World
from scene_experts.files.anchors.cfg_args import cfg_args_text
from scene_experts.files.anchors.layout import SIDECAR, SIDECAR_FORMAT, iteration_folder, read_sidecar
from scene_experts.files.anchors.read import UNKNOWN
from scene_experts.files.formats.splats import from_scene, to_columns
from scene_experts.files.formats.spz import is_antialiased
from scene_experts.files.formats.standard import FORMATS, format_of, read_standard
from scene_experts.files.ply import read_vertices, write_gaussian_ply
from scene_experts.recipes import gs_3d
from scene_experts.scene.gaussians import Explicit, GaussianScene
from scene_experts.training import run_folder
from scene_experts.training.config import Data, RunConfig, Train, from_json, to_json
from scene_experts.training.run_folder import OpenRun

log: logging.Logger = logging.getLogger(__name__)
KIND = "gaussians"  # in our description of a scene


def scene_of(run: OpenRun) -> GaussianScene:
    """The run's scene, which must be one of explicit Gaussians. Raises InputError where it is none."""
    if not isinstance(run.scene, GaussianScene):
        raise InputError(f"expected a scene of explicit Gaussians, found a run of '{run.config.train.recipe}'; use another --format")
    return run.scene


def write_file(scene: GaussianScene, world: World, path: Path) -> None:
    """Write the scene as a PLY file that readers of 3DGS open, in the capture's own frame. Raises RunError when the disk is full."""
    s = from_scene(scene, world)
    write_gaussian_ply(path, s.means, s.sh, s.opacity_logit, s.log_scales, s.quats)


def write_folder(run: OpenRun, world: World, out: Path) -> Path:
    """Write out/point_cloud/iteration_<step>/ and out/cfg_args; returns the iteration's folder."""
    scene, data = scene_of(run), run.config.data.settings()
    folder = out / "point_cloud" / f"iteration_{run.step}"
    write_file(scene, world, folder / "point_cloud.ply")
    about = {
        "format": SIDECAR_FORMAT,
        "kind": KIND,
        "recipe": run.config.train.recipe,
        "step": run.step,
        "K": 1,
        "F": 0,
        "sh_degree": scene.config.sh_degree,
        "voxel_size": {"trained": 0.0, "input": 0.0},
        "world": {"scale": world.scale, "shift": list(world.shift)},
        "extent": scene.extent,
        "train": to_json(run.config.train),
        "data": data,
    }
    write_json(folder / SIDECAR, about)
    write_bytes(out / "cfg_args", cfg_args_text({"sh_degree": scene.config.sh_degree}).encode())
    return folder


def find_file(source: Path, iteration: int | None = None) -> Path | None:
    """The file of explicit Gaussians that `source` is, in any of `standard.FORMATS`, or the PLY file that the result folder `source` holds.

    None where `source` is a compact file or a folder with another scene. Raises InputError for other files and for anchors without the
    networks that belong to them.
    """
    source = Path(source)
    if source.is_file():
        return None if _is_compact(source) else _gaussians(source)
    if (source / "point_cloud").is_dir() or (source / "point_cloud.ply").is_file():
        path = iteration_folder(source, iteration) / "point_cloud.ply"
    else:
        return None
    return path if "f_dc_0" in read_vertices(path) else None


def _is_compact(path: Path) -> bool:
    """Whether a file is meant as a compact one: by its name, or as safetensors begin (the length of a JSON header, then the header)."""
    with path.open("rb") as stream:
        head = stream.read(9)
    return path.suffix == ".compact" or (head[8:] == b"{" and 2 <= int.from_bytes(head[:8], "little") < path.stat().st_size)


def _gaussians(path: Path) -> Path:
    """`path`, when it begins like a file of Gaussians. Raises InputError else."""
    try:
        format = format_of(path)
    except InputError:
        raise InputError(
            f"expected a compact file or one of {', '.join(FORMATS)} at {path}, found something else; give another file"
        ) from None
    if format == "ply" and "f_offset_0" in read_vertices(path):
        raise InputError(
            f"expected Gaussians in {path}, found anchors, which need their networks; give the folder with point_cloud/iteration_N"
        )
    return path


def read_columns(path: Path, world: World) -> dict[str, Tensor]:
    """The columns of a table of explicit Gaussians, in the trained world, from a file of `standard.FORMATS` in the capture's own frame.

    Raises InputError for files without such Gaussians and for values that are not finite.
    """
    found = read_standard(path)
    if not len(found):
        raise InputError(f"expected Gaussians in {path}, found none; export the result again")
    for name, value in vars(found).items():
        bad = int((~value.isfinite()).reshape(len(value), -1).any(1).sum())
        if bad:
            raise InputError(f"expected finite {name} in {path}, found {bad:,} Gaussians with others; export the result again")
    return to_columns(found, world)


def _beside(path: Path) -> dict[str, Any]:
    """The description that `export` writes beside a standard file; empty where there is none."""
    file = path.with_name(path.name + ".json")
    found = read_json(file, "description of a file") if file.is_file() else None
    return found if isinstance(found, dict) else {}


def _antialias(path: Path) -> bool:
    """Whether an SPZ file, or the description that `export` writes beside a standard file, says that it is to be antialiased.

    Raises InputError where it says that the file is not in the capture's own frame.
    """
    found = _beside(path)
    if not found:
        return path.is_file() and format_of(path) == "spz" and is_antialiased(path)
    if found.get("frame") == "trained":
        raise InputError(
            f"expected a file in the capture's own frame, found {path} in the trained one; export it again with --frame capture"
        )
    return found.get("antialias") is True


def import_file(path: Path, data: Data, out: Path, iteration: int | None = None) -> Capture:
    """Make the run folder `out` (configuration and checkpoint) of a file of standard Gaussians, published or ours; returns its capture.

    The file must be in the frame and unit of the capture. A recipe that it does not say is 3DGS; an iteration that neither it nor its
    folder's name says is 0. Raises InputError where the description beside it (FILE.json) says another frame.
    """
    antialias = _antialias(path)
    beside = path.parent / SIDECAR
    about: dict[str, Any] = read_sidecar(beside) if beside.is_file() else {}
    capture = run_folder.load_capture(data)
    capture.images.close()
    made_on = _beside(path).get("capture")
    if made_on not in (None, "", capture.fingerprint()):
        log.warning(
            "%s was made on other views than those of %s: is it that capture, read as then (--split, --resolution)?", path, capture.root
        )
    columns = read_columns(path, capture.world)
    named = re.fullmatch(r"iteration_(\d+)", path.parent.name)
    step = int(about.get("step") or iteration or (int(named[1]) if named else UNKNOWN))
    degree = math.isqrt(columns["sh_rest"].shape[1] + 1) - 1
    if about.get("kind") == KIND and "train" in about:
        cfg = from_json(Train, about["train"], "train")
        if isinstance(cfg.scene, Explicit) and cfg.scene.sh_degree != degree:  # a format that keeps fewer harmonics
            cfg = replace(cfg, scene=replace(cfg.scene, sh_degree=degree))
    else:
        cfg = replace(gs_3d, scene=Explicit(sh_degree=degree), iterations=step or gs_3d.iterations, antialias=antialias)
    config = RunConfig(cfg, data, f"import {path.name}", versions=run_folder.versions())
    run_folder.prepare(out, config, resume=False)
    meta = {"recipe": cfg.recipe, "step": step, "seconds": 0.0, "extent": capture.extent, "config": "imported"}
    checkpoint.save(out / "checkpoints", step, {f"params.{name}": value for name, value in columns.items()}, meta)
    return capture
