"""Scenes of graph points to files: SAGS's PLY with the networks beside it, in the capture's own
frame.

From the trained world to the capture's frame, positions move and lengths scale: log-scalings, the
distances that networks see, and the cube of the hash grid.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any, cast

import numpy as np
import torch
from torch import Tensor

from scene_experts.core.checkpoint import write_tensors
from scene_experts.core.plain import to_json
from scene_experts.data.views import World
from scene_experts.files.formats.ply import Columns, floats, numbered_columns, write_vertices
from scene_experts.scene.graph.scene import GraphScene
from scene_experts.training.run_folder import OpenRun

KIND, DESCRIPTION_FORMAT = "graph points", 1
NETWORKS = "networks.safetensors"
INERT_OPACITY = math.log(0.1 / 0.9)  # SAGS stores it per point and never uses it


def contents(run: OpenRun, world: World, about: dict[str, Any]) -> tuple[Columns, dict[str, Tensor]]:
    """The columns of the PLY and the tensors of the networks."""
    scene = cast(GraphScene, run.scene)
    return vertices(scene, world), networks(scene, world.scale)


def describe(run: OpenRun, world: World) -> dict[str, Any]:
    """The description of a run: everything that its tensors do not say, as JSON values."""
    scene = cast(GraphScene, run.scene)
    low, edge = world.to_input(torch.tensor(scene.grid.low, dtype=torch.float64)).tolist(), scene.grid.edge / world.scale
    return {
        "format": DESCRIPTION_FORMAT,
        "kind": KIND,
        "recipe": run.config.train.recipe,
        "step": run.step,
        "K": scene.K,
        "F": scene.config.F,
        "voxel_size": {"trained": scene.voxel, "input": scene.voxel / world.scale},
        "world": {"scale": world.scale, "shift": list(world.shift)},
        "extent": scene.extent,
        "grid": {"low": low, "edge": edge, **to_json(scene.config.grid)},
    }


def write(run: OpenRun, world: World, folder: Path, about: dict[str, Any]) -> dict[str, Any]:
    """Write point_cloud.ply and the networks into `folder`; no settings for cfg_args. Raises
    RunError when the disk is full."""
    columns, tensors = contents(run, world, about)
    write_vertices(folder / "point_cloud.ply", columns)
    write_tensors(folder / NETWORKS, tensors, KIND, DESCRIPTION_FORMAT, {"grid": about["grid"], "step": run.step})
    return {}


def vertices(scene: GraphScene, world: World) -> Columns:
    """The columns of SAGS's PLY: 49 float32 (196 bytes) per point for F = 32; normals are 0,
    opacity and rotation are inert."""
    p = {name: value.detach().cpu() for name, value in scene.table.params.items()}
    xyz = world.to_input(scene.table.facts["xyz"].cpu().double()).float()
    scaling = (p["log_scaling"].double() - math.log(world.scale)).float()
    n = len(xyz)
    columns: Columns = dict(zip("xyz", floats(xyz)))
    columns |= {name: np.zeros(n, np.float32) for name in ("nx", "ny", "nz")}
    columns |= numbered_columns("feats_", p["feature"])
    columns["opacity"] = np.full(n, INERT_OPACITY, np.float32)
    columns |= numbered_columns("scale_", scaling)
    return columns | {f"rot_{i}": np.full(n, float(i == 0), np.float32) for i in range(4)}


def networks(scene: GraphScene, scale: float) -> dict[str, Tensor]:
    """The networks for distances in the capture's unit: the distance is the last input of all but
    the offsets' network."""
    out = {name: value.detach().cpu().clone() for name, value in scene.network_tensors().items()}
    for attribute in scene.heads:
        out[f"{attribute}.0"][:, -1] *= scale
    return out
