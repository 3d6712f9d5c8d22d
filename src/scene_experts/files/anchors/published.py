"""What published results of Scaffold-GS and Octree-GS do not state: the lattice, the levels of
detail, the recipe. Derived from their numbers."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from scene_experts.core.errors import InputError
from scene_experts.core.types import Camera
from scene_experts.data.views import Capture
from scene_experts.files.anchors.data import AnchorData
from scene_experts.files.placed import AROUND, PHOTOGRAPHED
from scene_experts.scene.anchors.features import FeatureBank
from scene_experts.scene.anchors.levels import LevelRule, Levels, centres
from scene_experts.scene.anchors.mlp import Plain
from scene_experts.scene.anchors.scene import Anchors
from scene_experts.scene.anchors.select import Octree
from scene_experts.training.config import Train
from scene_experts.training.recipes import octree_gs, scaffold_gs

RULES: dict[str, LevelRule] = {"round": "round", "floor": "floor", "ceil": "ceil", "progressive": "blend"}  # dist2level


def cells_of(xyz: Tensor, voxel: float, origin: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> Tensor | None:
    """The lattice cells [N, 3] int64 of positions [N, 3]; None for positions that do not lie on
    that lattice.

    float32 positions are rounded relative to the largest coordinate, so a few hundred-thousandths
    of it are allowed.
    """
    place = (xyz.double() - torch.tensor(origin, dtype=torch.float64)) / voxel
    cells = place.round()
    reach = float(xyz.double().abs().max()) / voxel if xyz.numel() else 0.0
    off = float((place - cells).abs().max()) if xyz.numel() else 0.0
    return cells.to(torch.int64) if off <= min(0.25, 1e-3 + 4e-7 * reach) else None


def recover_voxel(xyz: Tensor) -> float | None:
    """The edge of the lattice (origin 0) that positions [N, 3] lie on, for files that do not state
    it; None without such a lattice.

    The smallest gap between the values of an axis is nearly always one cell. It is fitted to all
    positions and then checked.
    """
    guesses = []
    for axis in range(3):
        values = xyz[:, axis].double().unique()
        gaps = values.diff()
        gaps = gaps[gaps > 4e-6 * float(values.abs().max())] if len(values) > 1 else gaps
        guesses += [float(gaps.min())] if len(gaps) else []
    if not guesses:
        return None
    edge, flat = min(guesses), xyz.double().flatten()
    for reach in flat.abs().sort().values[torch.linspace(0, len(flat) - 1, 32).long()].tolist():  # near ones first: their cells are certain
        near = flat[flat.abs() <= reach]
        cells = (near / edge).round()
        if bool(cells.any()):
            edge = float((near * cells).sum() / (cells * cells).sum())
    return edge if cells_of(xyz, edge) is not None else None


def levels_of(columns: dict[str, Tensor], cameras: Sequence[Camera], settings: Mapping[str, Any] | None = None) -> Levels:
    """The levels of an Octree-GS result, in the capture's unit. No file states the lattice's
    origin: any anchor of the coarsest level gives it.

    settings: its cfg_args (fork, dist2level). Raises InputError where they or the column info hold
    no usable values.
    """
    fork, rule = (settings or {}).get("fork", 2), RULES.get(str((settings or {}).get("dist2level", "round")))
    if not isinstance(fork, int) or not 2 <= fork <= 16 or rule is None:
        raise InputError(
            f"expected a fork of 2 to 16 and a dist2level among {', '.join(RULES)} in cfg_args, found {fork} and "
            f"{(settings or {}).get('dist2level')}; correct the file"
        )
    level, info = columns["level"], columns.get("info", torch.zeros(0))
    if len(level) < 2 or not (info[:2] > 0).all():
        raise InputError("expected the cell edge and the distance of Octree-GS in its column info, found none; export the result again")
    first = int(level.min())
    x, y, z = columns["xyz"][int((level == first).nonzero()[0])].tolist()
    count = int(level.max()) + 1
    return Levels(count, count // 2, fork, float(info[0]), (x, y, z), float(info[1]), rule, 0.0, centres(cameras))


def meta_of(data: AnchorData, capture: Capture) -> dict[str, Any]:
    """The values of `Scene.meta` that a result implies with its capture: levels of detail, and the
    views of appearance codes.

    Raises InputError where the capture has another number of training views than the result has
    codes.
    """
    out: dict[str, Any] = {}
    if "level" in data.columns:
        out["levels"] = levels_of(data.columns, [capture.views[i].camera for i in capture.train], data.settings).meta()
    if "appearance.table" in data.networks:
        codes = len(data.networks["appearance.table"])
        if capture.kind in (AROUND, PHOTOGRAPHED):  # no view of the training has a number there
            return out | {"views": list(range(codes))}
        if codes != len(capture.train):
            raise InputError(
                f"expected {codes} training views, one per appearance code, found {len(capture.train)}; choose another --split"
            )
        out["views"] = list(capture.train)
    return out


def recipe_of(data: AnchorData) -> Train:
    """Scaffold-GS, or Octree-GS, with the numbers that a result shows."""
    w1, columns = data.networks["opacity.experts.w1"], data.columns
    depth = 2 + sum(name.startswith("opacity.middle.") and name.endswith(".weight") for name in data.networks)
    K, F = columns["offsets"].shape[1], columns["feature"].shape[1]
    scene = Anchors(K=K, F=F, hidden=w1.shape[1], add_dist=data.add_dist, voxel_size=max(data.voxel, 0.0), decoder=Plain(depth))
    if "feature_bank.experts.w1" in data.networks:
        scene = replace(scene, mix=FeatureBank(data.networks["feature_bank.experts.w1"].shape[1]))
    if "appearance.table" in data.networks:
        scene = replace(scene, appearance=data.networks["appearance.table"].shape[1])
    if "level" in columns:
        fork, rule = data.settings.get("fork", 2), RULES[str(data.settings.get("dist2level", "round"))]
        scene = replace(scene, select=Octree(fork=fork, rule=rule))
        return replace(octree_gs, scene=scene, iterations=data.step or octree_gs.iterations)
    return replace(scaffold_gs, scene=scene, iterations=data.step or scaffold_gs.iterations)
