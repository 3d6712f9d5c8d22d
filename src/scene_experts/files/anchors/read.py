"""Files to runs: a run folder made of a published Scaffold-GS result, of one of ours, or of a compact file."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from scene_experts.core import checkpoint
from scene_experts.core.errors import InputError
from scene_experts.data.views import Capture, World
from scene_experts.files.anchors.compact import Compact, read_compact
from scene_experts.files.anchors.extras import RULES, level_facts, levels_in, published_levels, trained_names
from scene_experts.files.anchors.frame import (
    Network,
    anchors_from_input,
    cell_positions,
    cells_of,
    lattice_to_input,
    networks_from_input,
    recover_voxel,
)
from scene_experts.files.anchors.layout import read_scaffold_folder
from scene_experts.recipes import octree_gs, scaffold_gs
from scene_experts.scene.anchors.features import FeatureBank
from scene_experts.scene.anchors.levels import Levels
from scene_experts.scene.anchors.mlp import Plain
from scene_experts.scene.anchors.scene import ATTRIBUTES, Anchors
from scene_experts.scene.anchors.select import Octree
from scene_experts.training import run_folder
from scene_experts.training.config import Data, RunConfig, Train, from_json

UNKNOWN = 0  # the step of files that do not say how long they were trained


@dataclass(frozen=True)
class _Read:
    """What a file holds, in the input frame."""

    anchors: dict[str, Tensor]
    cells: Tensor | None  # None: on no lattice that is known
    voxel: float  # input unit
    networks: dict[str, Network]
    add_dist: tuple[str, ...]
    step: int  # 0 where nothing says it
    scene: dict[str, Any] | None  # our description
    cfg: dict[str, Any] = field(default_factory=dict)  # cfg_args


def import_result(source: Path, data: Data, out: Path, iteration: int | None = None) -> Capture:
    """Make the run folder `out` (configuration and checkpoint) of a published Scaffold-GS result folder, of ours, or of a compact file.

    A published result is in its capture's own units, so its capture is read with --normalise none. Ours must meet the world it was trained
    in. Returns the capture in that world. Raises InputError for what cannot be rendered here and for captures that do not fit.
    """
    read = _read(Path(source), iteration)
    if read.scene is None:
        data = replace(data, normalise="none")
    capture = run_folder.load_capture(data)
    capture.images.close()
    if read.scene is not None:
        check_world(world_in(read.scene), capture.world)
        capture = replace(capture, world=world_in(read.scene))
    voxel = float(read.scene["voxel_size"]["trained"]) if read.scene else read.voxel
    plain = _plain_values(read, capture)
    levels = levels_in(plain)
    tensors = run_tensors(read.anchors, read.cells, read.networks, read.add_dist, voxel, capture.world, levels, read.scene is not None)
    cfg = _config(read)
    config = RunConfig(cfg, data, f"import {Path(source).name}", versions=run_folder.versions())
    run_folder.prepare(out, config, resume=False)
    extent = float((read.scene or {}).get("extent", capture.extent))
    voxel = levels.size(levels.count - 1) if levels else voxel
    meta = {"recipe": cfg.recipe, "step": read.step, "seconds": 0.0, **plain, "voxel": voxel, "extent": extent, "config": "imported"}
    checkpoint.save(out / "checkpoints", read.step, tensors, meta)
    return capture


def _plain_values(read: _Read, capture: Capture) -> dict[str, Any]:
    """What a checkpoint must say of levels and appearance codes: from our description, or from the files and the capture."""
    if read.scene is not None:
        return dict(read.scene.get("scene", {}))
    out: dict[str, Any] = {}
    if "level" in read.anchors:
        out["levels"] = published_levels(read.anchors, [capture.views[i].camera for i in capture.train], read.cfg).meta()
    if "appearance" in read.networks:
        codes = len(read.networks["appearance"]["table"])
        if codes != len(capture.train):
            raise InputError(
                f"expected {codes} training views, one for each appearance code, found {len(capture.train)}; choose another --split"
            )
        out["views"] = list(capture.train)
    return out


def run_tensors(
    anchors: dict[str, Tensor], cells: Tensor | None, networks: dict[str, Network], add_dist: tuple[str, ...], voxel: float, world: World,
    levels: Levels | None = None, exact: bool = True,
) -> dict[str, Tensor]:  # fmt: skip
    """The tensors of a checkpoint, in the trained world, from anchors and networks in the input frame.

    voxel: edge of the lattice in trained units.  cells: None for anchors on no lattice that is known; they cannot grow or be packed.
    levels: the lattices of anchors with a level, in trained units; exact: their positions follow from their cells.
    """
    moved = anchors_from_input(anchors, world)
    place = {"cell": torch.zeros(len(moved["xyz"]), 3, dtype=torch.int64), "xyz": moved["xyz"]}
    if cells is not None:
        place = {"cell": cells, "xyz": cell_positions(cells, voxel)}
    if levels is not None:
        place = level_facts(levels, moved, exact)
    trained = networks_from_input(trained_names(networks, world.scale), add_dist, world.scale, moved["feature"].shape[1])
    out = {f"params.{name}": moved[name] for name in ("feature", "offsets", "log_scaling")}
    out |= {f"facts.{name}": value for name, value in place.items()}
    return out | {f"network.{a}.{name}": value for a, n in trained.items() for name, value in n.items()}


def compact_anchors(file: Compact) -> dict[str, Tensor]:
    """The anchors' columns of a compact file, in the input frame."""
    return {"xyz": file.xyz, "feature": file.feature, "offsets": file.offsets, "log_scaling": file.log_scaling}


def world_in(sidecar: dict[str, Any]) -> World:
    """The world that our description of a scene states."""
    x, y, z = (float(v) for v in sidecar["world"]["shift"])
    return World(float(sidecar["world"]["scale"]), (x, y, z))


def _read(source: Path, iteration: int | None) -> _Read:
    """A compact file, or a result folder."""
    if source.is_file():
        c = read_compact(source)
        add_dist = tuple(a for a in ATTRIBUTES if c.sidecar["add_dist"][a])
        return _Read(compact_anchors(c), c.cells, c.voxel, c.networks, add_dist, int(c.sidecar["step"]), c.sidecar)
    anchors, networks, facts = read_scaffold_folder(source, iteration)
    scene, spare = facts["scene"], {a: n["w1"].shape[2] - facts["F"] - 3 for a, n in networks.items() if a in ATTRIBUTES}
    by_level = scene is None and facts["kind"] == "octree" and facts["cfg"].get("add_level") is True
    if by_level or max(spare["opacity"], spare["cov"], spare["color"] - facts["appearance_dim"]) > 1:
        raise InputError(
            f"expected networks that see feature, direction and distance in {source}, found ones that see the level too; train it here"
        )
    step = int((scene or {}).get("step") or facts["iteration"] or UNKNOWN)
    voxel, origin = float(facts["voxel_size"] or 0.0), (0.0, 0.0, 0.0)
    if facts["kind"] == "octree":  # its lattices are told by its own columns
        return _Read(anchors, None, voxel, networks, facts["add_dist"], step, scene, facts["cfg"])
    if scene is not None:
        voxel, origin = lattice_to_input(float(scene["voxel_size"]["trained"]), world_in(scene))
    elif voxel <= 0:  # it was automatic and is written nowhere
        voxel = recover_voxel(anchors["xyz"]) or 0.0
    cells = cells_of(anchors["xyz"], voxel, origin) if voxel > 0 else None
    return _Read(anchors, cells, voxel, networks, facts["add_dist"], step, scene)


def _config(read: _Read) -> Train:
    """The recipe: the one our description holds, else Scaffold-GS with the numbers that the files show."""
    if read.scene is not None and "train" in read.scene:
        return from_json(Train, read.scene["train"], "train")
    network, length = read.networks["opacity"], read.step or (octree_gs if "level" in read.anchors else scaffold_gs).iterations
    depth = 2 + sum(name.startswith("middle.") and name.endswith(".weight") for name in network)
    K, F = read.anchors["offsets"].shape[1], read.anchors["feature"].shape[1]
    scene = Anchors(K=K, F=F, hidden=network["w1"].shape[1], add_dist=read.add_dist, voxel_size=max(read.voxel, 0.0), decoder=Plain(depth))
    if "feature_bank" in read.networks:
        scene = replace(scene, mix=FeatureBank(read.networks["feature_bank"]["w1"].shape[1]))
    if "appearance" in read.networks:
        scene = replace(scene, appearance=read.networks["appearance"]["table"].shape[1])
    if "level" in read.anchors:
        fork, rule = read.cfg.get("fork", 2), RULES[str(read.cfg.get("dist2level", "round"))]
        return replace(octree_gs, scene=replace(scene, select=Octree(fork=fork, rule=rule)), iterations=length)
    return replace(scaffold_gs, scene=scene, iterations=length)


def check_world(trained: World, found: World) -> None:
    """Raises InputError unless the capture is read into the world the scene was trained in (to rounding)."""
    pairs = [(trained.scale, found.scale), *zip(trained.shift, found.shift)]
    reach = max(1.0, *(abs(s) for s in trained.shift))
    if any(abs(a - b) > 1e-5 * (abs(a) if i == 0 else reach) for i, (a, b) in enumerate(pairs)):
        raise InputError(
            f"expected the capture in the world of the scene (scale {trained.scale:.6g}, shift {trained.shift}), found scale "
            f"{found.scale:.6g}, shift {found.shift}; use the capture, --split, --normalise and --max-views it was trained with"
        )
