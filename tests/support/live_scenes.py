"""Scenes of anchors of every kind that a live page decodes, and what Python decodes from the same file."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from scene_experts.core.plain import to_json
from scene_experts.core.types import Camera, Mode
from scene_experts.data.settings import Data
from scene_experts.data.views import World
from scene_experts.files.anchors import FAMILY, live, write
from scene_experts.files.anchors.data import AnchorData
from scene_experts.files.anchors.read import scene as scene_of
from scene_experts.scene.anchors.experts import Experts
from scene_experts.scene.anchors.routers import Margin
from scene_experts.scene.anchors.select import Octree
from scene_experts.training.clock import Clock
from scene_experts.training.config import RunConfig, Train
from scene_experts.training.recipes import RECIPES
from scene_experts.training.run_folder import OpenRun
from support.scenes import start_scene

WORLD = World(scale=2.5, shift=(1.0, 0.1 + 0.2, -3.0))
STEP = 30_000
PLAIN = ("scene-experts", "scaffold-gs", "moe-gs", "moe-gs-dist", "moe-gs-posrouter", "moe-gs-balance", "moe-gs-e3-dense", "octree-gs")
CASES = (*PLAIN, "scaffold-gs-wide", "scene-experts-wide", "margin", "blend", "codes", "masks")


def _train(case: str) -> Train:
    if case in RECIPES:
        return RECIPES[case][1]
    moe = RECIPES["moe-gs"][1]
    scene: Any = {
        "margin": replace(moe.scene, decoder=Experts(num=4, top_k=2, router=Margin())),
        "blend": replace(moe.scene, select=Octree(rule="blend")),
        "codes": replace(moe.scene, appearance=5),
        "masks": replace(moe.scene, smoothing=0.2),
    }[case]
    return replace(moe, scene=scene)


@torch.no_grad()
def make_run(case: str) -> OpenRun:
    """A run of a case with random values."""
    train, g = _train(case), torch.Generator().manual_seed(3)
    scene: Any = start_scene(train)
    p, facts = scene.table.params, scene.table.facts
    p["feature"].copy_(torch.randn(p["feature"].shape, generator=g))
    p["offsets"].copy_(torch.randn(p["offsets"].shape, generator=g))
    p["log_scaling"].add_(0.3 * torch.randn(p["log_scaling"].shape, generator=g) - 0.5)
    for name, value in scene.network_tensors().items():
        value.mul_(2.0 if "router" not in name else 1.0)
        if name.endswith(("router_w", "router_balance")):
            value.copy_(0.3 * torch.randn(value.shape, generator=g))
    if case == "masks":
        facts["slots"] = torch.rand(len(facts["xyz"]), scene.K, generator=g) < 0.6
        facts["interval"] = 0.05 * torch.rand(len(facts["xyz"]), generator=g)
    return OpenRun(Path("nowhere"), RunConfig(train, Data(Path("nowhere"))), scene, STEP, Clock())


def contents_of(run: OpenRun) -> AnchorData:
    """The scene of a run as its files hold it."""
    about = FAMILY.describe(run, WORLD) | {"train": to_json(run.config)["train"], "data": {}}
    return write.contents(run, WORLD, about)


@dataclass(frozen=True)
class Seen:
    """A pose in the capture's frame, for the page, and the camera that it is in the trained world."""

    pose: dict[str, Any]
    camera: Camera


def look(position: tuple[float, float, float], fov: float = 50.0, width: int = 320, height: int = 240, near: float = 0.01) -> Seen:
    """A camera at a place of the trained world that looks at the scene's middle, (0, 0, 4)."""
    place = torch.tensor(position, dtype=torch.float64)
    z = torch.nn.functional.normalize(torch.tensor([0.0, 0.0, 4.0], dtype=torch.float64) - place, dim=0)
    x = torch.nn.functional.normalize(torch.linalg.cross(torch.tensor([0.0, 1.0, 0.1], dtype=torch.float64), z), dim=0)
    rotation = torch.stack([x, torch.linalg.cross(z, x), z], 1)
    pose = torch.eye(4, dtype=torch.float64)
    pose[:3, :3], pose[:3, 3] = rotation.T, -rotation.T @ place
    f = height / 2 / math.tan(math.radians(fov / 2))
    intrinsics = torch.tensor([[f, 0, width / 2], [0, f, height / 2], [0, 0, 1]])
    camera = Camera(pose.float(), intrinsics, width, height, near, id=-1)
    at = {"position": WORLD.to_input(place).tolist(), "rotation": rotation.tolist(), "fov": fov, "width": width, "height": height}
    return Seen(at, camera)


def scene_in_page(run: OpenRun, path: Path) -> Any:
    """The scene that a page holds."""
    return scene_of(run, live.read(path), WORLD)[0]


@torch.no_grad()
def decoded(scene: Any, camera: Camera, centre: Any) -> np.ndarray:
    """What Python decodes, as `LivePage.decoded` has it: lengths of the capture's frame, means relative to `centre`, dead ones 0."""
    d = (
        scene.finish(scene.decode_composed(scene.select(scene.table, camera, STEP, Mode.DRAW), camera, STEP), camera, STEP, Mode.DRAW)
        if (scene.traits.levels)
        else scene.finish(scene.decode_composed(torch.arange(len(scene.table)), camera, STEP), camera, STEP, Mode.DRAW)
    )
    g = d.gaussians
    out = np.zeros((len(scene.table) * scene.K, 16), np.float32)
    means = WORLD.to_input(g.means.double()) - torch.tensor(centre, dtype=torch.float64)
    quats = torch.where(g.quats[:, :1] < 0, -g.quats, g.quats)
    parts = [means, g.opacities[:, None], g.scales / WORLD.scale, torch.zeros(len(means), 1), quats, g.colors, torch.zeros(len(means), 1)]
    out[g.source.numpy()] = torch.cat([part.float() for part in parts], 1).numpy()
    return out


def compare(found: np.ndarray, wanted: np.ndarray) -> tuple[float, int]:
    """The largest difference of the Gaussians that both have, and the number of those that one has."""
    live_both = (found[:, 3] > 0) & (wanted[:, 3] > 0)
    a, b = found[live_both].copy(), wanted[live_both].copy()
    for part in (a, b):
        part[:, 8:12] *= np.where(part[:, 8:9] < 0, -1, 1)
    flipped = np.abs(a[:, 8:12] + b[:, 8:12]).max(1) < np.abs(a[:, 8:12] - b[:, 8:12]).max(1)  # w is about 0
    a[flipped, 8:12] *= -1
    columns = [*range(7), *range(8, 15)]
    return float(np.abs(a - b)[:, columns].max(initial=0)), int(((found[:, 3] > 0) != (wanted[:, 3] > 0)).sum())
