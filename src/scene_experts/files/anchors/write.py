"""Scenes of anchors to files: the trained scene in the capture's own frame, its description, and
the Scaffold-GS result folder.

From the trained world to the capture's frame, positions move, lengths scale, and axes stay. So
offsets (factors of the scaling), features and viewing directions are unchanged. A network that sees
the distance gets the scale folded into its first layer, so that a reader feeds it distances in the
file's unit.
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
from scene_experts.files.anchors import torchscript
from scene_experts.files.anchors.data import FILE_NAMES, AnchorData, by_attribute
from scene_experts.files.formats.ply import Columns, floats, numbered_columns, write_vertices
from scene_experts.scene.anchors.levels import Levels
from scene_experts.scene.anchors.mlp import ATTRIBUTES
from scene_experts.scene.anchors.scene import AnchorScene
from scene_experts.training.run_folder import OpenRun

DESCRIPTION_FORMAT = 1
MOE_FILE, MOE_KIND, MOE_FORMAT = "moe.safetensors", "mixture of experts", 1
INERT_OPACITY = math.log(0.1 / 0.9)  # logit(0.1): Scaffold-GS stores it per anchor and never uses it
LEVEL_COLUMNS = ("level", "extra_level", "info")  # of Octree-GS
SLOTS, SLOT_BITS = "slots_", 16  # columns of the masks, and slots per column
BANK_DISTANCE = 3  # index of the distance in the feature bank's input, after the direction
_LATTICE_TOLERANCE = 1e-3  # voxels


def contents(run: OpenRun, world: World, about: dict[str, Any]) -> AnchorData:
    """The scene of a run as files hold it. Raises InputError for a feature bank with other inputs
    than direction and distance."""
    scene = cast(AnchorScene, run.scene)
    facts, p = scene.table.facts, {name: value.detach().cpu() for name, value in scene.table.params.items()}
    xyz = facts["xyz"].cpu()
    columns = {
        "xyz": world.to_input(xyz.double()).float(),
        **p,
        "log_scaling": (p["log_scaling"].double() - math.log(world.scale)).float(),
    }
    x, y, z = world.shift
    cells = facts["cell"].cpu()
    if run.scene.traits.levels:
        columns |= {
            "level": facts["level"].cpu(),
            "extra_level": facts["extra_level"].cpu().float(),
            "info": level_info(scene, world.scale),
        }
    if "slots" in facts:
        columns["slots"] = facts["slots"].cpu()
    if "interval" in facts:
        columns["interval"] = facts["interval"].cpu() / world.scale
    edges: tuple[float, ...] = ()
    origin = (-x, -y, -z)
    on_lattice = not run.scene.traits.levels and is_on_lattice(cells, xyz, scene.voxel)
    if run.scene.traits.levels:
        levels = Levels.from_meta(scene.meta()["levels"])
        held = facts["level"].cpu()
        rows = [(held == j).nonzero().squeeze(1) for j in range(levels.count)]
        start = torch.tensor(levels.origin, dtype=torch.float64)
        on_lattice = all(is_on_lattice(cells[own], xyz[own].double() - start, levels.size(j)) for j, own in enumerate(rows))
        edges = tuple(levels.size(j) / world.scale for j in range(levels.count))
        a, b, c = world.to_input(start).tolist()
        origin = (a, b, c)
    return AnchorData(
        columns,
        networks(scene, world.scale),
        about,
        cells if on_lattice else None,
        scene.voxel / world.scale,
        origin,
        scene.config.add_dist,
        run.step,
        edges=edges,
    )


def is_on_lattice(cells: Tensor, xyz: Tensor, voxel: float) -> bool:
    """Whether positions [N, 3] are those of their cells [N, 3], up to float32 rounding. voxel: edge
    of a cell in the unit of xyz."""
    if not len(cells):
        return True
    away = float((cells.double() * voxel - xyz.double()).abs().max())
    return away <= _LATTICE_TOLERANCE * voxel + 1e-6 * float(xyz.abs().max())


def level_info(scene: AnchorScene, scale: float) -> Tensor:
    """Octree-GS's column info [N]: the edge of level 0 and the standard distance, in the capture's
    unit, in its first rows; then zeros."""
    levels = scene.meta()["levels"]
    out = torch.zeros(len(scene.table.facts["level"]))
    for i, value in enumerate((levels["edge"], levels["standard"])[: len(out)]):
        out[i] = value / scale
    return out


def networks(scene: AnchorScene, scale: float) -> dict[str, Tensor]:
    """The networks' tensors by their names in files, for distances in the capture's unit. scale:
    trained units per capture unit."""
    out: dict[str, Tensor] = {}
    for name, value in scene.network_tensors().items():
        part, _, rest = name.partition(".")
        out[f"{'feature_bank' if part == 'mix' else part}.{FILE_NAMES.get(rest, rest)}"] = value.detach().cpu()
    columns = {f"{a}.experts.w1": -1 - (scene.config.appearance if a == "color" else 0) for a in scene.config.add_dist}  # before the code
    columns |= {"feature_bank.experts.w1": BANK_DISTANCE} if "feature_bank.experts.w1" in out else {}
    for name, column in columns.items():
        w1 = out[name].clone()
        w1[:, :, column] = w1[:, :, column] * scale
        out[name] = w1
    return out


def describe(run: OpenRun, world: World) -> dict[str, Any]:
    """The description of a run: everything that the tensors of its files do not say, as JSON
    values. The capture's path is left out.

    The lattice in the capture's frame is position = cell * voxel_size.input - world.shift.
    """
    scene = cast(AnchorScene, run.scene)
    tensors = scene.network_tensors()
    E = {a: len(tensors[f"{a}.w1"]) for a in ATTRIBUTES}
    k = {a: scene.heads[a].k(run.step) if scene.heads[a].experts else None for a in ATTRIBUTES}  # type: ignore[union-attr]
    return {
        "format": DESCRIPTION_FORMAT,
        "recipe": run.config.train.recipe,
        "step": run.step,
        "K": scene.K,
        "F": scene.config.F,
        "E": E,
        "k": k,  # experts per anchor; None: dense, or a single network
        "phase": {a: "single" if E[a] == 1 else "dense" if k[a] is None else "sparse" for a in E},
        "add_dist": {a: a in scene.config.add_dist for a in ATTRIBUTES},
        "appearance_dim": scene.config.appearance,
        "activations": torchscript.ACTIVATIONS,
        "voxel_size": {"trained": scene.voxel, "input": scene.voxel / world.scale},
        "world": {"scale": world.scale, "shift": list(world.shift)},
        "feature_bank": scene.bank is not None,
        "extent": scene.extent,
        "scene": {name: value for name, value in scene.meta().items() if name != "steps"},  # files say them in their own way
    }


def write(run: OpenRun, world: World, folder: Path, about: dict[str, Any]) -> dict[str, Any]:
    """Write point_cloud.ply and the networks into `folder`; returns the settings for cfg_args.
    Raises RunError when the disk is full.

    Single networks are written as TorchScript, which the readers of Scaffold-GS expect, experts as
    moe.safetensors.
    """
    data = contents(run, world, about)
    write_vertices(folder / "point_cloud.ply", vertices(data))
    stale = {MOE_FILE, torchscript.UNITED_FILE, *torchscript.FILES.values(), *torchscript.EXTRA_FILES.values()}
    if is_plain(data.networks):
        by_part = by_attribute(data.networks)
        torchscript.write(folder, by_part)
        stale -= {(torchscript.FILES | torchscript.EXTRA_FILES)[part] for part in by_part}
    else:
        write_tensors(folder / MOE_FILE, data.networks, MOE_KIND, MOE_FORMAT, about)
        stale -= {MOE_FILE}
    for name in stale:  # from an earlier export to this folder
        (folder / name).unlink(missing_ok=True)
    growth = to_json(run.config.train.growth)
    return {
        "sh_degree": 3,
        "feat_dim": about["F"],
        "n_offsets": about["K"],
        "voxel_size": about["voxel_size"]["input"],
        "use_feat_bank": about["feature_bank"],
        "appearance_dim": about["appearance_dim"],
        **{f"add_{attribute}_dist": used for attribute, used in about["add_dist"].items()},
        "ratio": 1,  # every point of the capture is used
        "update_depth": growth.get("levels", 3),
        "update_init_factor": growth.get("init_factor", 16),
        "update_hierachy_factor": growth.get("hierarchy_factor", 4),  # spelt as in the published code
    }


def is_plain(networks: dict[str, Tensor]) -> bool:
    """Whether every attribute has a single network, as in Scaffold-GS. networks: by name in
    files."""
    return all(len(networks[f"{a}.experts.w1"]) == 1 and f"{a}.router.weight" not in networks for a in ATTRIBUTES)


def vertices(data: AnchorData) -> Columns:
    """The columns of Scaffold-GS's PLY: 79 float32 (316 bytes) per anchor for K = 10, F = 32.

    Offsets are stored component by component: f_offset_{c * K + k} is component c of offset k.
    Normals are 0, the opacity is inert, the rotation is the identity. With levels of detail, level,
    extra_level and info replace the normals, as in Octree-GS. Masks of slots and intervals of
    the smoothing filter are further columns, which other readers ignore.
    """
    c, n = data.columns, len(data.columns["xyz"])
    zero, one = np.zeros(n, np.float32), np.ones(n, np.float32)
    columns: Columns = dict(zip("xyz", floats(c["xyz"])))
    levels = {name: floats(c[name][:, None])[0] for name in LEVEL_COLUMNS if name in c}
    columns |= levels or dict.fromkeys(("nx", "ny", "nz"), zero)
    columns |= numbered_columns("f_offset_", c["offsets"].transpose(1, 2).flatten(1))
    columns |= numbered_columns("f_anchor_feat_", c["feature"])
    columns["opacity"] = np.full(n, INERT_OPACITY, np.float32)
    columns |= numbered_columns("scale_", c["log_scaling"])
    columns |= {"rot_0": one, "rot_1": zero, "rot_2": zero, "rot_3": zero}
    columns |= {"interval": floats(c["interval"][:, None])[0]} if "interval" in c else {}
    return columns | (numbered_columns(SLOTS, pack_slots(c["slots"])) if "slots" in c else {})


def pack_slots(slots: Tensor) -> Tensor:
    """Masks [N, K] bool as whole numbers [N, ceil(K / 16)] float32; bit i of number j is slot 16 j
    + i."""
    groups = torch.nn.functional.pad(slots, (0, -slots.shape[1] % SLOT_BITS)).view(len(slots), -1, SLOT_BITS)
    return (groups.long() << torch.arange(SLOT_BITS)).sum(2).float()


def unpack_slots(numbers: Tensor, K: int) -> Tensor:
    """The inverse of `pack_slots`."""
    return (numbers.long()[..., None] >> torch.arange(SLOT_BITS) & 1).bool().flatten(1)[:, :K].contiguous()


@torch.no_grad()
def warnings(run: OpenRun) -> list[str]:
    """What readers of the result folder get wrong: single networks of a form that TorchScript files
    of Scaffold-GS cannot express."""
    scene = cast(AnchorScene, run.scene)
    plain = networks(scene, 1.0)
    facts, readers = scene.table.facts, "warning: other readers of the Scaffold-GS layout"
    hidden = int((~facts["slots"]).sum()) if "slots" in facts else 0
    told = f"{readers} also draw the Gaussians that this scene hides ({hidden:,}); files of other formats leave them out"
    masked = [told] if hidden else []
    masked += [f"{readers} draw without the smoothing filter"] if "interval" in facts else []
    if not is_plain(plain):
        return masked
    others = []
    for attribute, network in by_attribute(plain).items():
        if attribute not in ATTRIBUTES:
            continue
        x = torch.randn(64, network["w1"].shape[2], generator=torch.Generator().manual_seed(0))
        own, _ = scene.heads[attribute](x, x[:, : scene.config.F], run.step)
        if not torch.allclose(own, torchscript.sequential(attribute, network)(x), atol=1e-4, rtol=1e-4):
            others.append(attribute)
    if not others:
        return masked
    what = f"the {', '.join(others)} networks of '{run.config.train.recipe}' are not Linear, ReLU, ..., Linear"
    return [*masked, f"warning: {what}, the only form that the Scaffold-GS layout can express: other readers will draw another scene"]
