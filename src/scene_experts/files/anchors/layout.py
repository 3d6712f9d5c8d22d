"""The result folder of Scaffold-GS, read and written: point_cloud/iteration_<N>/ with anchors, networks and our description of them.

Published folders hold point_cloud.ply, opacity_mlp.pt, cov_mlp.pt, color_mlp.pt (TorchScript; or all in checkpoints.pth) and, above them,
cfg_args. Ours hold the same, with moe.safetensors in place of the three networks where there are experts, and scene.json: what the other
files do not say (voxel size, world, recipe, experts per anchor). Everything in a folder is in the capture's own frame and unit.
"""

from __future__ import annotations

import math
import re
from pathlib import Path
from typing import Any

from torch import Tensor

from scene_experts.core.errors import InputError
from scene_experts.core.io import read_json, write_bytes, write_json
from scene_experts.files.anchors.cfg_args import cfg_args_text, read_cfg_args
from scene_experts.files.anchors.frame import Network
from scene_experts.files.anchors.networks import (
    ACTIVATIONS,
    ATTRIBUTES,
    EXTRA_FILES,
    FILES,
    MOE_FILE,
    check_networks,
    is_plain,
    read_moe,
    read_torchscript,
    write_moe,
    write_torchscript,
)
from scene_experts.files.ply import read_anchor_ply, write_anchor_ply

SIDECAR_FORMAT = 1
SIDECAR = "scene.json"


def describe(
    *, recipe: str, networks: dict[str, Network], k: dict[str, int | None], K: int, F: int, add_dist: tuple[str, ...], voxel_size: float,
    scale: float, shift: tuple[float, float, float], step: int, extra: dict[str, Any] | None = None,
) -> dict[str, Any]:  # fmt: skip
    """The sidecar: everything about a scene that its tensors do not say, as plain JSON.

    k: experts chosen per anchor by attribute, None while dense; voxel_size: edge of the lattice in trained units; scale, shift: the world,
    trained = (input + shift) * scale. The lattice in the input frame is position = cell * voxel_size / scale - shift.
    """
    E = {a: len(n["w1"]) for a, n in networks.items()}
    return {
        "format": SIDECAR_FORMAT,
        "recipe": recipe,
        "step": step,
        "K": K,
        "F": F,
        "E": E,
        "k": {a: k.get(a) for a in E},
        "phase": {a: "single" if E[a] == 1 else "dense" if k.get(a) is None else "sparse" for a in E},
        "add_dist": {a: a in add_dist for a in ATTRIBUTES},
        "appearance_dim": 0,
        "activations": ACTIVATIONS,
        "voxel_size": {"trained": voxel_size, "input": voxel_size / scale},
        "world": {"scale": scale, "shift": list(shift)},
        **(extra or {}),
    }


def iteration_folder(path: Path, iteration: int | None = None) -> Path:
    """The folder of `iteration` (None: the newest) below a result folder; a folder that itself holds point_cloud.ply is taken as it is."""
    path = Path(path)
    if (path / "point_cloud.ply").is_file():
        return path
    found = {}
    for folder in (path / "point_cloud").glob("iteration_*") if (path / "point_cloud").is_dir() else ():
        if (match := re.fullmatch(r"iteration_(\d+)", folder.name)) and (folder / "point_cloud.ply").is_file():
            found[int(match[1])] = folder
    if not found:
        raise InputError(f"expected a Scaffold-GS result (point_cloud/iteration_N/point_cloud.ply) in {path}, found none; check the path")
    if iteration is not None and iteration not in found:
        raise InputError(f"expected iteration {iteration} in {path}, found {', '.join(map(str, sorted(found)))}; choose one of those")
    return found[max(found) if iteration is None else iteration]


def read_scaffold_folder(path: Path, iteration: int | None = None) -> tuple[dict[str, Tensor], dict[str, Network], dict[str, Any]]:
    """Anchors, networks and facts of a result folder, published or ours, in the frame of its files.

    anchors: as `ply.read_anchor_ply`.  networks: by attribute, stacked (see `networks`), with feature_bank and appearance where present.
    facts: iteration, K, F, kind ("scaffold" or "octree"), add_dist (attributes whose network is wider than feature and direction: the
    distance, and in Octree-GS perhaps the level), appearance_dim, voxel_size (input unit; None when nothing says it, 0 or less when it was
    automatic), cfg (cfg_args), scene (our sidecar or None).
    Raises InputError for whatever is absent, damaged or does not fit.
    """
    folder = iteration_folder(path, iteration)
    anchors = read_anchor_ply(folder / "point_cloud.ply")
    networks = read_moe(folder / MOE_FILE)[0] if (folder / MOE_FILE).is_file() else read_torchscript(folder)
    check_networks(networks, str(folder))
    scene = read_sidecar(folder / SIDECAR) if (folder / SIDECAR).is_file() else None
    config = folder.parent.parent / "cfg_args"
    cfg = read_cfg_args(config) if config.is_file() else {}
    K, F = anchors["offsets"].shape[1], anchors["feature"].shape[1]
    match = re.fullmatch(r"iteration_(\d+)", folder.name)
    facts: dict[str, Any] = {
        "iteration": int(match[1]) if match else None,
        "K": K,
        "F": F,
        "kind": "octree" if "level" in anchors else "scaffold",
        "voxel_size": scene["voxel_size"]["input"] if scene else _number(cfg.get("voxel_size")),
        "cfg": cfg,
        "scene": scene,
    }
    return anchors, networks, facts | _inputs(networks, facts, str(folder))


def _number(value: Any) -> float | None:
    return float(value) if isinstance(value, (int, float)) and math.isfinite(value) else None


def _inputs(networks: dict[str, Network], facts: dict[str, Any], where: str) -> dict[str, Any]:
    """What the networks take beside feature and direction, read off their widths; InputError where the widths do not fit the anchors."""
    K, F = facts["K"], facts["F"]
    appearance = networks["appearance"]["table"].shape[1] if "appearance" in networks else 0
    most = 2 if facts["kind"] == "octree" else 1
    add_dist = []
    for attribute, channels in zip(ATTRIBUTES, (1, 7, 3)):
        network = networks[attribute]
        spare = network["w1"].shape[2] - F - 3 - (appearance if attribute == "color" else 0)
        outputs = network["w2"].shape[1]
        if not 0 <= spare <= most or outputs != channels * K:
            raise InputError(
                f"expected {attribute} networks of {F + 3} inputs (1 more with the distance) and {channels * K} outputs in {where}, "
                f"found {network['w1'].shape[2]} and {outputs}; use the files of one training"
            )
        if spare:
            add_dist.append(attribute)
    return {"add_dist": tuple(add_dist), "appearance_dim": appearance}


def read_sidecar(path: Path) -> dict[str, Any]:
    """Our description of a scene. Raises InputError when it is damaged or of another format version."""
    value = read_json(path, "scene description")
    if not isinstance(value, dict) or value.get("format") != SIDECAR_FORMAT:
        found = value.get("format") if isinstance(value, dict) else value
        raise InputError(f"expected a scene description of format {SIDECAR_FORMAT} at {path}, found format {found}; write the scene again")
    absent = {"K", "F", "voxel_size", "world", "recipe"} - value.keys()
    if absent:
        raise InputError(f"expected {', '.join(sorted(absent))} in the scene description {path}, found none; write the scene again")
    try:
        numbers = [*map(float, value["voxel_size"].values()), float(value["world"]["scale"]), *map(float, value["world"]["shift"])]
        others = [float(value.get("extent", 1)), int(value.get("step", 0)), *dict(value.get("scene", {}))]
        if len(numbers) != 6 or not numbers[2] > 0 or not others[0] > 0:
            raise ValueError
    except (AttributeError, KeyError, TypeError, ValueError):
        raise InputError(
            f"expected voxel_size, world, extent and step as numbers in the scene description {path}, found others; write it again"
        ) from None
    return value


def write_scaffold_folder(
    out: Path, step: int, anchors: dict[str, Tensor], networks: dict[str, Network] | None, sidecar: dict[str, Any]
) -> Path:
    """Write anchors and networks, in the input frame already (`frame`), to out/point_cloud/iteration_<step>; returns that folder.

    anchors: xyz [N, 3], offsets [N, K, 3], feature [N, F], log_scaling [N, 6], and for levels of detail level, extra_level, info [N].
    networks: None writes none.  sidecar: `describe`.
    Single networks are written as TorchScript, which public readers expect, experts as moe.safetensors. cfg_args is written beside them
    with what those readers look up. Raises RunError when the disk is full.
    """
    folder = Path(out) / "point_cloud" / f"iteration_{step}"
    levels = {name: anchors[name] for name in ("level", "extra_level", "info") if name in anchors}
    write_anchor_ply(folder / "point_cloud.ply", *(anchors[name] for name in ("xyz", "offsets", "feature", "log_scaling")), levels=levels)
    stale = {MOE_FILE, *FILES.values(), *EXTRA_FILES.values(), "checkpoints.pth"}
    if networks is not None and is_plain(networks):
        write_torchscript(folder, networks)
        stale -= set(FILES.values()) | {EXTRA_FILES[name] for name in EXTRA_FILES if name in networks}
    elif networks is not None:
        write_moe(folder / MOE_FILE, networks, sidecar)
        stale -= {MOE_FILE}
    for name in stale:  # of an earlier export to this folder
        (folder / name).unlink(missing_ok=True)
    write_json(folder / SIDECAR, sidecar)
    write_bytes(Path(out) / "cfg_args", cfg_args_text(_cfg(sidecar)).encode())
    return folder


def _cfg(sidecar: dict[str, Any]) -> dict[str, Any]:
    """The settings under the names that Scaffold-GS's tools use."""
    dist = sidecar["add_dist"]
    return {
        "sh_degree": 3,
        "feat_dim": sidecar["F"],
        "n_offsets": sidecar["K"],
        "voxel_size": sidecar["voxel_size"]["input"],
        "use_feat_bank": sidecar.get("feature_bank", False),
        "appearance_dim": sidecar["appearance_dim"],
        "add_opacity_dist": dist["opacity"],
        "add_cov_dist": dist["cov"],
        "add_color_dist": dist["color"],
    }
