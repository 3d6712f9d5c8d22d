"""Graph points as files: SAGS's PLY layout and the networks beside it, in the capture's own frame.

From the trained world to the capture's frame positions move and lengths scale: log-scalings, the networks' distances, the grid's cube.
"""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from scene_experts.core.checkpoint import write_tensors
from scene_experts.core.errors import InputError
from scene_experts.core.io import write_json
from scene_experts.data.views import World
from scene_experts.files.anchors.layout import SIDECAR, SIDECAR_FORMAT
from scene_experts.files.ply import ANCHOR_OPACITY, write_vertices
from scene_experts.scene.graph.scene import GraphScene
from scene_experts.training.config import to_json
from scene_experts.training.run_folder import OpenRun

KIND = "graph points"  # in our description of a scene
NETWORKS = "networks.safetensors"


def refuse(run: OpenRun) -> None:
    """Raises InputError for a scene of graph points: no file of anchors holds what its networks need."""
    if isinstance(run.scene, GraphScene):
        raise InputError(
            f"expected a scene of anchors for this format, found a run of '{run.config.train.recipe}'; "
            "use a standard format such as ply; its own files are in point_cloud/ of the run folder, where training wrote them"
        )


def write_folder(run: OpenRun, world: World, out: Path) -> Path:
    """Write out/point_cloud/iteration_<step>/ (PLY, networks, description); returns that folder. RunError when the disk is full."""
    scene = run.scene
    assert isinstance(scene, GraphScene)
    folder = out / "point_cloud" / f"iteration_{run.step}"
    write_points(folder / "point_cloud.ply", scene, world)
    low, edge = world.to_input(torch.tensor(scene.grid.low, dtype=torch.float64)).tolist(), scene.grid.edge / world.scale
    grid = {"low": low, "edge": edge, **to_json(scene.config.grid)}
    write_tensors(folder / NETWORKS, networks_to_input(scene, world.scale), KIND, SIDECAR_FORMAT, {"grid": grid, "step": run.step})
    about = {
        "format": SIDECAR_FORMAT,
        "kind": KIND,
        "recipe": run.config.train.recipe,
        "step": run.step,
        "K": scene.K,
        "F": scene.config.F,
        "voxel_size": {"trained": scene.voxel, "input": scene.voxel / world.scale},
        "world": {"scale": world.scale, "shift": list(world.shift)},
        "extent": scene.extent,
        "grid": grid,
        "train": to_json(run.config.train),
        "data": run.config.data.settings(),
    }
    write_json(folder / SIDECAR, about)
    return folder


def write_points(path: Path, scene: GraphScene, world: World) -> None:
    """Write the points in SAGS's layout: 49 float32 (196 bytes) a point for F = 32; normals 0, opacity and rotation inert."""
    p = {name: value.detach().cpu() for name, value in scene.table.params.items()}
    xyz = world.to_input(scene.table.facts["xyz"].cpu().double()).float()
    scaling = (p["log_scaling"].double() - math.log(world.scale)).float()
    n = len(xyz)
    columns = dict(zip("xyz", xyz.numpy().T))
    columns |= {name: np.zeros(n, np.float32) for name in ("nx", "ny", "nz")}
    columns |= {f"feats_{i}": column for i, column in enumerate(p["feature"].float().numpy().T)}
    columns["opacity"] = np.full(n, ANCHOR_OPACITY, np.float32)
    columns |= {f"scale_{i}": column for i, column in enumerate(scaling.numpy().T)}
    columns |= {f"rot_{i}": np.full(n, float(i == 0), np.float32) for i in range(4)}
    write_vertices(path, columns)


def networks_to_input(scene: GraphScene, scale: float) -> dict[str, Tensor]:
    """The networks for distances in the capture's unit: the distance is the last input of all but the offsets' network."""
    out = {name: value.detach().cpu().clone() for name, value in scene.network_tensors().items()}
    for attribute in scene.heads:
        out[f"{attribute}.0"][:, -1] *= scale
    return out
