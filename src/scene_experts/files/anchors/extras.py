"""What some anchor scenes have beyond plain ones, to files and back: levels of detail, a feature bank, appearance codes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import torch
from torch import Tensor

from scene_experts.core.errors import InputError
from scene_experts.core.types import Camera
from scene_experts.files.anchors.frame import Network
from scene_experts.scene.anchors.levels import LevelRule, Levels, centres
from scene_experts.scene.anchors.scene import AnchorScene
from scene_experts.scene.anchors.select import LevelSelector

RULES: dict[str, LevelRule] = {"round": "round", "floor": "floor", "ceil": "ceil", "progressive": "blend"}  # dist2level
BANK_DISTANCE = 3  # the feature bank's input: direction, distance


def level_columns(scene: AnchorScene, scale: float) -> dict[str, Tensor]:
    """Octree-GS's columns [N]: level, extra_level, and info with the edge of level 0 and the standard distance (input unit) in its first
    rows; nothing for scenes without levels. scale: trained units per input unit."""
    if not isinstance(scene.select, LevelSelector):
        return {}
    info, levels = torch.zeros(len(scene.table)), scene.select.lattices
    for i, value in enumerate((levels.edge, levels.standard)[: len(info)]):
        info[i] = value / scale
    return {"level": scene.table.facts["level"].cpu(), "extra_level": scene.table.facts["extra_level"].cpu().float(), "info": info}


def extra_networks(scene: AnchorScene, scale: float) -> dict[str, Network]:
    """The feature bank's network, which then takes distances in the input unit, and the table of codes, by the names of their files."""
    out: dict[str, Network] = {}
    if scene.mix is not None:
        out["feature_bank"] = rescaled({name: p.detach().cpu() for name, p in scene.mix.named_parameters()}, scale)
    if scene.codes is not None:
        out["appearance"] = {"table": scene.codes.table.detach().cpu()}
    return out


def rescaled(bank: Network, scale: float) -> Network:
    """A feature bank whose distances are `scale` times as short. Raises InputError for one with other inputs."""
    w1 = bank["w1"].clone()
    if w1.shape[2] != BANK_DISTANCE + 1:
        raise InputError(
            f"expected a feature bank that sees direction and distance ({BANK_DISTANCE + 1} numbers), found one of {w1.shape[2]}; "
            "train the scene here"
        )
    w1[:, :, BANK_DISTANCE] = w1[:, :, BANK_DISTANCE] * scale
    return bank | {"w1": w1}


def trained_names(networks: dict[str, Network], scale: float) -> dict[str, Network]:
    """The inverse of `extra_networks`: by the names of a scene's parts, in the trained unit; the heads are passed on."""
    out = {name: network for name, network in networks.items() if name != "feature_bank"}
    if "feature_bank" in networks:
        out["mix"] = rescaled(networks["feature_bank"], 1.0 / scale)
    return out


def published_levels(anchors: dict[str, Tensor], cameras: Sequence[Camera], cfg: Mapping[str, Any] | None = None) -> Levels:
    """The levels of an Octree-GS result (input unit, in which it was trained): any anchor of the coarsest level marks the lattice, whose
    origin no file keeps. cfg: its cfg_args (fork, dist2level). Raises InputError where `info` says nothing, or these nothing known."""
    fork, rule = (cfg or {}).get("fork", 2), RULES.get(str((cfg or {}).get("dist2level", "round")))
    if not isinstance(fork, int) or not 2 <= fork <= 16 or rule is None:
        raise InputError(
            f"expected a fork of 2 to 16 and a dist2level among {', '.join(RULES)} in cfg_args, found {fork} and "
            f"{(cfg or {}).get('dist2level')}; correct the file"
        )
    level, info = anchors["level"], anchors.get("info", torch.zeros(0))
    if len(level) < 2 or not (info[:2] > 0).all():
        raise InputError("expected the cell edge and the distance of Octree-GS in its column info, found none; export the result again")
    first = int(level.min())
    x, y, z = anchors["xyz"][int((level == first).nonzero()[0])].tolist()
    count = int(level.max()) + 1
    return Levels(count, count // 2, fork, float(info[0]), (x, y, z), float(info[1]), rule, 0.0, centres(cameras))


def level_facts(levels: Levels, anchors: dict[str, Tensor], exact: bool) -> dict[str, Tensor]:
    """The facts of anchors in the trained world: their cells, and their positions anew from them (`exact`) or as they are."""
    level, xyz = anchors["level"], anchors["xyz"]
    cells, places = torch.zeros(len(xyz), 3, dtype=torch.int64), xyz.clone()
    for j in level.unique().tolist():
        rows = (level == j).nonzero().squeeze(1)
        cells[rows] = levels.cells(xyz[rows], j)
        places[rows] = levels.positions(cells[rows], j).float()
    extra = anchors.get("extra_level", torch.zeros(len(xyz)))
    return {"cell": cells, "xyz": places if exact else xyz, "level": level, "extra_level": extra}


def levels_in(meta: dict[str, Any]) -> Levels | None:
    """The levels that a checkpoint's plain values describe."""
    return Levels.from_meta(meta["levels"]) if "levels" in meta else None
