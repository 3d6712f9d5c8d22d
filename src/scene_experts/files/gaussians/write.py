"""Scenes of explicit Gaussians to files: as `Splats` in the capture's own frame, and the result
folder of 3DGS.

From the trained world to the capture's frame, positions move, lengths scale, and axes stay. So
rotations and harmonics are unchanged.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import torch

from scene_experts.data.views import World
from scene_experts.files.formats import ply
from scene_experts.files.formats.splats import Splats
from scene_experts.scene import Scene
from scene_experts.training.run_folder import OpenRun

KIND, DESCRIPTION_FORMAT = "gaussians", 1


def splats_of(scene: Scene, world: World) -> Splats:
    """The Gaussians of a scene of explicit Gaussians, in the capture's own frame."""
    p = {name: value.detach().cpu() for name, value in scene.table.params.items()}
    return Splats(
        means=world.to_input(p["means"].double()).float(),
        log_scales=(p["log_scales"].double() - math.log(world.scale)).float(),
        quats=p["quats"].float(),
        opacity_logit=p["raw_opacity"].float(),
        sh=torch.cat([p["sh_dc"][:, None], p["sh_rest"]], dim=1).float(),
    )


def contents(run: OpenRun, world: World, about: dict[str, Any]) -> Splats:
    """The Gaussians of a run, in the capture's own frame."""
    return splats_of(run.scene, world)


def describe(run: OpenRun, world: World) -> dict[str, Any]:
    """The description of a run: everything that its PLY does not say, as JSON values."""
    return {
        "format": DESCRIPTION_FORMAT,
        "kind": KIND,
        "recipe": run.config.train.recipe,
        "step": run.step,
        "K": 1,
        "F": 0,
        "sh_degree": run.scene.traits.sh_degree,
        "voxel_size": {"trained": 0.0, "input": 0.0},
        "world": {"scale": world.scale, "shift": list(world.shift)},
        "extent": run.scene.extent,
    }


def write(run: OpenRun, world: World, folder: Path, about: dict[str, Any]) -> dict[str, Any]:
    """Write point_cloud.ply into `folder`; returns the settings for cfg_args. Raises RunError when
    the disk is full."""
    ply.write(folder / "point_cloud.ply", splats_of(run.scene, world), {})
    return {"sh_degree": about["sh_degree"]}
