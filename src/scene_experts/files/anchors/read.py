"""Files to runs of anchors: a published result folder of Scaffold-GS or Octree-GS, one of ours, or
a compact file.

Published folders hold point_cloud.ply and opacity_mlp.pt, cov_mlp.pt, color_mlp.pt (or all networks
in checkpoints.pth). Ours hold the same, with moe.safetensors in place of the three networks where
there are experts, and the description scene.json.
"""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import torch
from torch import Tensor

from scene_experts.core.checkpoint import read_tensors
from scene_experts.core.errors import InputError
from scene_experts.core.plain import from_json
from scene_experts.core.reading import budget
from scene_experts.core.reading.source import guarding
from scene_experts.data import capture as captures
from scene_experts.data.settings import Data
from scene_experts.data.views import World
from scene_experts.files import result_folder
from scene_experts.files.anchors import torchscript
from scene_experts.files.anchors.data import AnchorData, Network, by_attribute, by_file_name
from scene_experts.files.anchors.published import cells_of, meta_of, recipe_of, recover_voxel
from scene_experts.files.anchors.write import BANK_DISTANCE, LEVEL_COLUMNS, MOE_FILE, MOE_FORMAT, MOE_KIND, SLOT_BITS, SLOTS, unpack_slots
from scene_experts.files.formats.ply import numbered_names, property_names, read_vertices, stack
from scene_experts.files.placed import place_cameras
from scene_experts.files.registry import Imported
from scene_experts.files.registry import read as read_file
from scene_experts.files.result_folder import data_in, expect_world, file_world, origin_in, world_in
from scene_experts.scene import Scene, restore_scene
from scene_experts.scene.anchors.levels import Levels
from scene_experts.scene.anchors.mlp import ATTRIBUTES, CHANNELS, Attribute
from scene_experts.training.config import Train
from scene_experts.training.run_folder import OpenRun

MOST_LEVELS = 64  # of detail


def find(source: Path, iteration: int | None) -> Path | None:
    """The iteration's folder of a result folder with anchors; None for other scenes."""
    folder = result_folder.iteration_folder(source, iteration)
    return folder if "f_offset_0" in property_names(folder / "point_cloud.ply") else None


def read(source: Path, data: Data | None, iteration: int | None) -> Imported:
    """The run in an iteration's folder or in a file of anchors.

    A published result is in its capture's own unit, so its capture is read with --normalise none. A
    result of ours must meet the world that it was trained in. Raises InputError for scenes that
    cannot be drawn here and for captures that do not fit.
    """
    with guarding(source, budget.HEAD, "scene of anchors"):
        return _read(source, data)


def _read(source: Path, data: Data | None) -> Imported:
    found = read_folder(source) if source.is_dir() else read_file(source)
    networks = by_attribute(found.networks)
    check_networks(networks, str(source))
    about = found.about
    if about is not None:
        result_folder.check_description(about)
    origin = origin_in(about or {})
    if data is None:
        data, world = data_in(about or {"data": {"normalise": "none"}}), World() if about is None else world_in(about)
        places = world.seen_from(origin).from_input(found.columns["xyz"].double())
        capture = place_cameras(source, places, world, origin, data.background)
    else:
        data = replace(data, normalise="none") if about is None else result_folder.drawn_as(data, about)
        capture = captures.load(data)
        capture.images.close()
    if about is None:
        meta, voxel, cfg = meta_of(found, capture), found.voxel, recipe_of(found)
    else:
        expect_world(world_in(about), capture.world)
        capture = replace(capture, world=world_in(about))
        meta, voxel = dict(about.get("scene", {})), float(about["voxel_size"]["trained"])
        cfg = from_json(Train, about["train"], "train") if "train" in about else recipe_of(found)
    levels = Levels.from_meta(meta["levels"]) if "levels" in meta else None
    world = capture.world if about is None else file_world(about)
    tensors = tensors_of(found, networks, world, voxel, levels, exact=about is not None)
    meta |= {
        "voxel": levels.size(levels.count - 1) if levels else voxel,
        "extent": float((about or {}).get("extent", capture.extent)),
    }
    return Imported(cfg, data, capture, tensors, meta, found.step, origin)


def scene(run: OpenRun, contents: AnchorData, world: World) -> tuple[Scene, int]:
    """The scene that a file holds, in the world and with the configuration of the run that it was
    written from."""
    networks = by_attribute(contents.networks)
    check_networks(networks, "the file")
    levels = Levels.from_meta(run.scene.meta()["levels"]) if run.scene.traits.levels else None
    tensors = tensors_of(contents, networks, world, run.scene.traits.voxel, levels)
    return restore_scene(run.config.train.scaled_scene(), tensors, run.scene.meta()).eval(), run.step


# --- the trained world --------------------------------------------------------------------------------------------------------------------


def tensors_of(
    data: AnchorData, networks: dict[str, Network], world: World, voxel: float, levels: Levels | None = None, exact: bool = True
) -> dict[str, Tensor]:
    """The tensors of a checkpoint, in the trained world.

    networks: those of `data`, by attribute. voxel: edge of the lattice in trained units; anchors on
    no known lattice cannot grow and cannot be written as a compact file. levels: the lattices of
    anchors with a level, in trained units. exact: compute positions from cells.
    """
    c = data.columns
    xyz = world.from_input(c["xyz"].double()).float()
    place = {"cell": torch.zeros(len(xyz), 3, dtype=torch.int64), "xyz": xyz}
    if data.cells is not None:
        place = {"cell": data.cells, "xyz": (data.cells.double() * voxel).float()}
    if levels is not None:
        place = level_facts(levels, xyz, c, exact)
    trained = for_trained_unit(networks, data.add_dist, c["feature"].shape[1], world.scale)
    scaling = (c["log_scaling"].double() + math.log(world.scale)).float()
    out = {"params.feature": c["feature"], "params.offsets": c["offsets"], "params.log_scaling": scaling}
    out |= {f"facts.{name}": value for name, value in place.items()}
    out |= {"facts.slots": c["slots"]} if "slots" in c else {}
    out |= {"facts.interval": c["interval"] * world.scale} if "interval" in c else {}
    return out | {f"network.{a}.{name}": value for a, n in trained.items() for name, value in n.items()}


def for_trained_unit(networks: dict[str, Network], add_dist: tuple[Attribute, ...], features: int, scale: float) -> dict[str, Network]:
    """Networks that see distances in trained units, by the names of a scene's parts: the inverse of
    `write.networks`, up to rounding.

    Raises InputError for a feature bank with other inputs than direction and distance.
    """
    out = {("mix" if name == "feature_bank" else name): network for name, network in networks.items()}
    if "mix" in out and out["mix"]["w1"].shape[2] != BANK_DISTANCE + 1:
        raise InputError(
            f"expected a feature bank that sees direction and distance ({BANK_DISTANCE + 1} numbers), found one that sees "
            f"{out['mix']['w1'].shape[2]}; train the scene here"
        )
    columns = dict.fromkeys(add_dist, features + 3) | ({"mix": BANK_DISTANCE} if "mix" in out else {})
    for name, column in columns.items():
        w1 = out[name]["w1"].clone()
        w1[:, :, column] = w1[:, :, column] * (1.0 / scale)
        out[name] = out[name] | {"w1": w1}
    return out


def level_facts(levels: Levels, xyz: Tensor, columns: dict[str, Tensor], exact: bool) -> dict[str, Tensor]:
    """The table's facts of anchors with levels, trained world: cells, and positions computed from
    them (`exact`) or as they are."""
    level = columns["level"]
    cells, places = torch.zeros(len(xyz), 3, dtype=torch.int64), xyz.clone()
    for j in level.unique().tolist():
        rows = (level == j).nonzero().squeeze(1)
        cells[rows] = levels.cells(xyz[rows], j)
        places[rows] = levels.positions(cells[rows], j).float()
    extra = columns.get("extra_level", torch.zeros(len(xyz)))
    return {"cell": cells, "xyz": places if exact else xyz, "level": level, "extra_level": extra}


# --- result folders -----------------------------------------------------------------------------------------------------------------------


def read_folder(folder: Path) -> AnchorData:
    """The scene in an iteration's folder, published or ours. Raises InputError for whatever is
    missing, damaged or does not fit."""
    with guarding(folder, budget.HEAD, "scene of anchors"):
        return _read_folder(folder)


def _read_folder(folder: Path) -> AnchorData:
    columns = read_anchors(folder / "point_cloud.ply")
    if (folder / MOE_FILE).is_file():
        networks = by_attribute(read_tensors(folder / MOE_FILE, MOE_KIND, MOE_FORMAT)[0])
    else:
        networks = torchscript.read(folder)
    check_networks(networks, str(folder))
    about, settings = result_folder.read_description(folder), result_folder.read_settings(folder)
    by_level = False if about is not None else settings.get("add_level") is True if settings else None
    add_dist = distance_inputs(networks, columns, by_level, str(folder))
    step = (about or {}).get("step") or result_folder.iteration_of(folder) or 0
    flat = by_file_name(networks)
    if "level" in columns:  # its own columns state the lattices
        voxel = about["voxel_size"]["input"] if about else result_folder.positive(settings.get("voxel_size"))
        return AnchorData(columns, flat, about, None, float(voxel or 0.0), add_dist=add_dist, step=step, settings=settings).checked()
    origin = (0.0, 0.0, 0.0)
    if about is not None:
        world = file_world(about)
        x, y, z = world.shift
        voxel, origin = float(about["voxel_size"]["trained"]) / world.scale, (-x, -y, -z)
    else:
        voxel = float(result_folder.positive(settings.get("voxel_size")) or 0.0)
        voxel = voxel if voxel > 0 else recover_voxel(columns["xyz"]) or 0.0  # 0: it was automatic, and no file states it
    cells = cells_of(columns["xyz"], voxel, origin) if voxel > 0 else None
    return AnchorData(columns, flat, about, cells, voxel, origin, add_dist, step, settings).checked()


def read_anchors(path: Path) -> dict[str, Tensor]:
    """The columns of a PLY of Scaffold-GS or Octree-GS: see `AnchorData.columns`.

    Raises InputError for files without such columns, and for values that are not finite.
    """
    columns = read_vertices(path)
    if "f_offset_0" not in columns:
        what = "Gaussians of 3DGS" if "f_dc_0" in columns else f"only {', '.join(list(columns)[:8])}"
        raise InputError(f"expected anchors (x, f_offset_*, f_anchor_feat_*, scale_*) in {path}, found {what}; give a Scaffold-GS result")
    out = {"xyz": stack(columns, ["x", "y", "z"], path, exact=True)}
    flat = stack(columns, numbered_names(columns, "f_offset_"), path)
    if flat.shape[1] % 3:
        raise InputError(f"expected three f_offset columns per Gaussian in {path}, found {flat.shape[1]} in all; write the file again")
    out["offsets"] = flat.reshape(len(flat), 3, flat.shape[1] // 3).transpose(1, 2).contiguous()
    out["feature"] = stack(columns, numbered_names(columns, "f_anchor_feat_"), path)
    out["log_scaling"] = stack(columns, [f"scale_{i}" for i in range(6)], path)
    for name in ("xyz", "offsets", "feature", "log_scaling"):
        bad = int((~out[name].isfinite()).flatten(1).any(1).sum())
        if bad:
            raise InputError(f"expected finite {name} in {path}, found {bad:,} anchors with others; export the result again")
    if "level" in columns:
        levels = {name: stack(columns, [name], path)[:, 0] for name in LEVEL_COLUMNS if name in columns}
        level = levels["level"]
        if not all(value.isfinite().all() for value in levels.values()) or not ((level >= 0) & (level <= MOST_LEVELS)).all():
            raise InputError(f"expected finite levels between 0 and {MOST_LEVELS} in {path}, found others; export the result again")
        out |= levels | {"level": level.round().long()}
    if "interval" in columns:
        out["interval"] = stack(columns, ["interval"], path)[:, 0]
    if masks := numbered_names(columns, SLOTS):
        K = out["offsets"].shape[1]
        if len(masks) != -(-K // SLOT_BITS):
            raise InputError(f"expected {-(-K // SLOT_BITS)} columns of masks in {path}, found {len(masks)}; export the result again")
        out["slots"] = unpack_slots(stack(columns, masks, path).nan_to_num(0).clamp(0, (1 << SLOT_BITS) - 1), K)
    return out


def distance_inputs(networks: dict[str, Network], columns: dict[str, Tensor], by_level: bool | None, where: str) -> tuple[Attribute, ...]:
    """The attributes whose network sees the distance: it has one input more than feature, direction
    and appearance code.

    by_level: the networks also see the level (Octree-GS's add_level); None: nothing says whether.
    Raises InputError for such networks, which cannot be drawn here, where it is not known of anchors
    with levels, and for widths that do not fit the anchors.
    """
    K, F = columns["offsets"].shape[1], columns["feature"].shape[1]
    codes = networks["appearance"]["table"].shape[1] if "appearance" in networks else 0
    most = 2 if "level" in columns else 1
    spare: dict[str, int] = {}
    for attribute in ATTRIBUTES:
        w1, w2 = networks[attribute]["w1"], networks[attribute]["w2"]
        spare[attribute] = w1.shape[2] - F - 3 - (codes if attribute == "color" else 0)
        if not 0 <= spare[attribute] <= most or w2.shape[1] != CHANNELS[attribute] * K:
            raise InputError(
                f"expected {attribute} networks of {F + 3} inputs (1 more with the distance) and {CHANNELS[attribute] * K} outputs "
                f"in {where}, found {w1.shape[2]} and {w2.shape[1]}; use the files of one training"
            )
    if by_level is None and "level" in columns and max(spare.values()) == 1:
        raise InputError(
            f"expected cfg_args beside the point_cloud folder of {where}, which says whether the networks see the distance or the level, "
            "found none; copy it there"
        )
    if by_level or max(spare.values()) > 1:
        raise InputError(
            f"expected networks that see feature, direction and distance in {where}, found networks that see the level too; train it here"
        )
    return tuple(attribute for attribute in ATTRIBUTES if spare[attribute])


def check_networks(networks: dict[str, Network], where: str) -> None:
    """Raises InputError unless every attribute has stacked tensors that fit together."""
    for attribute in ATTRIBUTES:
        n = networks.get(attribute, {})
        if not {"w1", "b1", "w2", "b2"} <= n.keys():
            raise InputError(f"expected the networks of {', '.join(ATTRIBUTES)} in {where}, found {sorted(networks)}; write the file again")
        if any(n[name].ndim != rank for name, rank in (("w1", 3), ("b1", 2), ("w2", 3), ("b2", 2))):
            raise InputError(f"expected stacked {attribute} networks in {where}, found tensors of other shapes; write the file again")
        (E, H, _), out = n["w1"].shape, n["w2"].shape[1]
        shapes = {"b1": (E, H), "w2": (E, out, H), "b2": (E, out), "router_b": (E,)}
        wrong = [name for name, shape in shapes.items() if name in n and n[name].shape != shape]
        router = [name for name in n if name.startswith("router_")]
        if wrong or (E > 1 and not router) or ("router_w" in n and len(n["router_w"]) != E):
            raise InputError(
                f"expected {attribute} networks of {E} experts that fit together in {where}, found others; write the file again"
            )
