"""Graph points from our own files (`graph_points`) back to a run.

SAGS's published `checkpoint.pth` is refused: it holds memory images of another hash grid and of half-precision networks, padded for a GPU.
"""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from scene_experts.core import checkpoint
from scene_experts.core.errors import InputError
from scene_experts.data.views import Capture, World
from scene_experts.files.anchors.layout import SIDECAR, iteration_folder, read_sidecar
from scene_experts.files.anchors.read import check_world, world_in
from scene_experts.files.graph.write import KIND, NETWORKS
from scene_experts.files.ply import read_vertices
from scene_experts.geometry.voxel import coarsen
from scene_experts.scene.graph.scene import CHANNELS, HALF
from scene_experts.training import run_folder
from scene_experts.training.config import Data, RunConfig, Train, from_json


def find_folder(source: Path, iteration: int | None = None) -> Path | None:
    """The folder of graph points that a result folder holds; None where it holds another scene. Raises InputError for SAGS's own files."""
    source = Path(source)
    if not (source / "point_cloud").is_dir() and not (source / "point_cloud.ply").is_file():
        return None
    folder = iteration_folder(source, iteration)
    if (folder / SIDECAR).is_file():
        return folder if read_sidecar(folder / SIDECAR).get("kind") == KIND else None
    if "feats_0" in read_vertices(folder / "point_cloud.ply"):
        raise InputError(
            f"expected a scene of graph points that was trained here in {folder}, found SAGS's own files, whose hash grid is another; "
            "train the capture here with the recipe for SAGS"
        )
    return None


def import_folder(folder: Path, data: Data, out: Path) -> Capture:
    """Make the run folder `out` (configuration and checkpoint) of our folder of graph points; returns its capture.

    Raises InputError where files are absent or damaged, or the capture is read into another world than the scene was trained in.
    """
    about = read_sidecar(folder / SIDECAR)
    if absent := {"grid", "extent", "step", "train"} - about.keys():
        raise InputError(f"expected {', '.join(sorted(absent))} in {folder / SIDECAR}, found none; copy the whole folder")
    world, cfg = world_in(about), from_json(Train, about.get("train"), "train")
    capture = run_folder.load_capture(data)
    capture.images.close()
    check_world(world, capture.world)
    voxel = float(about["voxel_size"]["trained"])
    tensors = {**rows(folder / "point_cloud.ply", world, voxel), **networks(folder / NETWORKS, world.scale)}
    config = RunConfig(cfg, data, f"import {folder.name}", versions=run_folder.versions())
    run_folder.prepare(out, config, resume=False)
    checkpoint.save(out / "checkpoints", int(about["step"]), tensors, meta(about, cfg, world, voxel))
    return replace(capture, world=world)


def meta(about: dict[str, Any], cfg: Train, world: World, voxel: float) -> dict[str, Any]:
    """The plain values of a checkpoint: the grid's cube in the trained world among them."""
    low = world.from_input(torch.tensor(about["grid"]["low"], dtype=torch.float64)).tolist()
    grid = {"grid_low": low, "grid_edge": float(about["grid"]["edge"]) * world.scale}
    plain = {"recipe": cfg.recipe, "step": int(about["step"]), "seconds": 0.0, "config": "imported"}
    return {**plain, **grid, "voxel": voxel, "extent": float(about["extent"])}


def rows(path: Path, world: World, voxel: float) -> dict[str, Tensor]:
    """The columns of the table, in the trained world: positions are on the lattice of half voxels, exactly.

    Raises InputError where columns are absent.
    """
    found = {name: torch.from_numpy(column.copy()) for name, column in read_vertices(path).items()}
    stack = lambda names: torch.stack([found[name] for name in names], dim=1)  # noqa: E731
    features = max(1, sum(name.startswith("feats_") for name in found))
    needed = [*"xyz", *(f"feats_{i}" for i in range(features)), *(f"scale_{i}" for i in range(6))]
    if absent := [name for name in needed if name not in found]:
        raise InputError(f"expected the columns of graph points in {path}, found no {', '.join(absent)}; copy the whole folder")
    twice = (world.from_input(stack("xyz").double()) * (HALF / voxel)).round().long()
    return {
        "facts.cell": coarsen(twice, HALF),
        "facts.xyz": (twice.double() * (voxel / HALF)).float(),
        "params.feature": stack([f"feats_{i}" for i in range(features)]),
        "params.log_scaling": (stack([f"scale_{i}" for i in range(6)]).double() + math.log(world.scale)).float(),
    }


def networks(path: Path, scale: float) -> dict[str, Tensor]:
    """The networks for distances in trained units."""
    if not path.is_file():
        raise InputError(f"expected the networks of the scene at {path}, found none; copy the whole folder")
    tensors, _ = checkpoint.read_tensors(path, KIND)
    for attribute in CHANNELS:
        tensors[f"{attribute}.0"][:, -1] /= scale
    return {f"network.{name}": value for name, value in tensors.items()}
