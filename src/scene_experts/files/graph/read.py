"""Files to runs of graph points: the result folders that `write` makes.

SAGS's published `checkpoint.pth` is refused: it holds memory images of another hash grid and of
half-precision networks, padded for a GPU.
"""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from scene_experts.core.checkpoint import read_tensors
from scene_experts.core.errors import InputError
from scene_experts.core.plain import from_json
from scene_experts.core.reading import budget
from scene_experts.core.reading.numbers import FARTHEST, LARGEST, LARGEST_LOG, expect_finite_tensors, expect_range, number
from scene_experts.core.reading.source import guarding
from scene_experts.data import capture as captures
from scene_experts.data.settings import Data
from scene_experts.data.views import World
from scene_experts.files import result_folder
from scene_experts.files.formats.ply import property_names, read_vertices
from scene_experts.files.graph.write import KIND, NETWORKS
from scene_experts.files.placed import place_cameras
from scene_experts.files.registry import Imported
from scene_experts.files.result_folder import data_in, expect_world, file_world, origin_in, world_in
from scene_experts.geometry.voxel import coarsen
from scene_experts.scene.graph.scene import CHANNELS, HALF
from scene_experts.training.config import Train


def find(source: Path, iteration: int | None) -> Path | None:
    """The iteration's folder of a result folder with graph points; None for other scenes. Raises
    InputError for SAGS's own files."""
    folder = result_folder.iteration_folder(source, iteration)
    about = result_folder.read_description(folder)
    if about is not None:
        return folder if about.get("kind") == KIND else None
    if "feats_0" in property_names(folder / "point_cloud.ply"):
        raise InputError(
            f"expected a scene of graph points that was trained here in {folder}, found SAGS's own files, whose hash grid is another; "
            "train the capture here with the recipe for SAGS"
        )
    return None


def read(source: Path, data: Data | None, iteration: int | None) -> Imported:
    """The run in an iteration's folder. Raises InputError for missing or damaged files and for a
    capture in another world."""
    with guarding(source, budget.HEAD, "scene of graph points"):
        return _read(source, data)


def _read(source: Path, data: Data | None) -> Imported:
    about = result_folder.read_description(source) or {}
    if absent := {"grid", "extent", "step", "train"} - about.keys():
        raise InputError(f"expected {', '.join(sorted(absent))} in {source / result_folder.DESCRIPTION}, found none; copy the whole folder")
    world, cfg = world_in(about), from_json(Train, about.get("train"), "train")
    voxel = float(about["voxel_size"]["trained"])
    tensors = {**rows(source / "point_cloud.ply", file_world(about), voxel), **networks(source / NETWORKS, world.scale)}
    if data is None:
        data = data_in(about)
        capture = place_cameras(source, tensors["facts.xyz"].double(), world, origin_in(about), data.background)
    else:
        data = result_folder.drawn_as(data, about)
        capture = captures.load(data)
        capture.images.close()
        expect_world(world, capture.world)
    found = replace(capture, world=world)
    return Imported(cfg, data, found, tensors, meta(about, world, voxel), int(about["step"]), origin_in(about))


def meta(about: dict[str, Any], world: World, voxel: float) -> dict[str, Any]:
    """The values of `Scene.meta`; the cube of the grid in the trained world."""
    corner = [number(v, "a corner of the grid", -FARTHEST, FARTHEST) for v in about["grid"]["low"]]
    low = world.from_input(torch.tensor(corner, dtype=torch.float64)).tolist()
    grid = {"grid_low": low, "grid_edge": number(about["grid"]["edge"], "the edge of the grid", 1e-15, FARTHEST) * world.scale}
    return {"voxel": voxel, "extent": float(about["extent"]), **grid}


def rows(path: Path, world: World, voxel: float) -> dict[str, Tensor]:
    """The columns of the table, in the trained world. Positions lie exactly on the lattice of half
    voxels.

    Raises InputError for missing columns.
    """
    found = {name: torch.from_numpy(column.copy()) for name, column in read_vertices(path).items()}
    stack = lambda names: torch.stack([found[name] for name in names], dim=1)  # noqa: E731
    features = max(1, sum(name.startswith("feats_") for name in found))
    needed = [*"xyz", *(f"feats_{i}" for i in range(features)), *(f"scale_{i}" for i in range(6))]
    if absent := [name for name in needed if name not in found]:
        raise InputError(f"expected the columns of graph points in {path}, found no {', '.join(absent)}; copy the whole folder")
    for name in needed:
        expect_range(found[name], name, -FARTHEST, FARTHEST if name in "xyz" else LARGEST_LOG if name.startswith("scale_") else LARGEST)
    twice = (world.from_input(stack("xyz").double()) * (HALF / voxel)).round().long()
    return {
        "facts.cell": coarsen(twice, HALF),
        "facts.xyz": (twice.double() * (voxel / HALF)).float(),
        "params.feature": stack([f"feats_{i}" for i in range(features)]),
        "params.log_scaling": (stack([f"scale_{i}" for i in range(6)]).double() + math.log(world.scale)).float(),
    }


def networks(path: Path, scale: float) -> dict[str, Tensor]:
    """The networks for distances in trained units. Raises InputError for a missing or damaged
    file."""
    if not path.is_file():
        raise InputError(f"expected the networks of the scene at {path}, found none; copy the whole folder")
    tensors, _ = read_tensors(path, KIND)
    expect_finite_tensors(tensors)
    for attribute in CHANNELS:
        tensors[f"{attribute}.0"][:, -1] /= scale
    return {f"network.{name}": value for name, value in tensors.items()}
