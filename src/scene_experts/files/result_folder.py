"""Result folders of the 3DGS family, read: point_cloud/iteration_N with our description of the
scene, and cfg_args above it.

Published folders have no description. Everything in a folder is in the capture's own frame and
unit.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

from scene_experts.core.errors import InputError
from scene_experts.core.io import read_json
from scene_experts.core.plain import from_json
from scene_experts.core.reading import budget
from scene_experts.core.reading.budget import Damaged
from scene_experts.core.reading.numbers import FARTHEST, number, whole_number
from scene_experts.core.reading.plain import parse_namespace
from scene_experts.core.reading.source import guarding, opening
from scene_experts.data.settings import Data
from scene_experts.data.views import Vector, World

DESCRIPTION, DESCRIPTION_FORMAT = "scene.json", 1
SETTINGS = "cfg_args"
MOST_STEPS = 1 << 40  # iterations of a training


def is_result(path: Path) -> bool:
    """Whether a folder looks like a result folder, or like one of its iterations."""
    return (path / "point_cloud").is_dir() or (path / "point_cloud.ply").is_file()


def iteration_folder(path: Path, iteration: int | None = None) -> Path:
    """The folder of `iteration` (None: the newest) in a result folder; a folder that holds
    point_cloud.ply itself is returned as it is.

    Raises InputError for a folder without results or without that iteration.
    """
    path = Path(path)
    if (path / "point_cloud.ply").is_file():
        return path
    found = {}
    for folder in (path / "point_cloud").glob("iteration_*") if (path / "point_cloud").is_dir() else ():
        if (number := iteration_of(folder)) is not None and (folder / "point_cloud.ply").is_file():
            found[number] = folder
    if not found:
        raise InputError(f"expected a result (point_cloud/iteration_N/point_cloud.ply) in {path}, found none; check the path")
    if iteration is not None and iteration not in found:
        raise InputError(f"expected iteration {iteration} in {path}, found {', '.join(map(str, sorted(found)))}; choose one of those")
    return found[max(found) if iteration is None else iteration]


def iteration_of(folder: Path) -> int | None:
    """N of a folder called iteration_N; None for other names."""
    match = re.fullmatch(r"iteration_(\d{1,18})", folder.name)
    return int(match[1]) if match else None


def read_description(folder: Path) -> dict[str, Any] | None:
    """The description of the scene in an iteration's folder; None where there is none.

    Raises InputError for a damaged one and for another format version.
    """
    path = folder / DESCRIPTION
    if not path.is_file():
        return None
    value = read_json(path, "scene description")
    if not isinstance(value, dict) or value.get("format") != DESCRIPTION_FORMAT:
        found = value.get("format") if isinstance(value, dict) else value
        raise InputError(
            f"expected a scene description of format {DESCRIPTION_FORMAT} at {path}, found format {found}; write the scene again"
        )
    absent = {"K", "F", "voxel_size", "world", "recipe"} - value.keys()
    if absent:
        raise InputError(f"expected {', '.join(sorted(absent))} in the scene description {path}, found none; write the scene again")
    with guarding(path, budget.JSON, "scene description"):
        check_description(value)
    return value


def check_description(value: dict[str, Any]) -> None:
    """Raise Damaged unless the numbers of a description are in range."""
    size, world = value["voxel_size"], value["world"]
    if not isinstance(size, dict) or not isinstance(world, dict) or not isinstance(world.get("shift"), list):
        raise Damaged("a voxel_size or a world of another form")
    lengths = [number(v, "voxel_size", 0, FARTHEST) for v in size.values()]
    shift = [number(v, "the shift of the world", -FARTHEST, FARTHEST) for v in world["shift"]]
    if len(lengths) != 2 or len(shift) != 3:
        raise Damaged("another number of lengths in voxel_size and world")
    number(world.get("scale"), "the scale of the world", 1e-15, FARTHEST)
    origin_in(value)
    number(value.get("extent", 1), "the extent", 1e-15, FARTHEST)
    whole_number(value.get("step", 0), "step", 0, MOST_STEPS)
    whole_number(value["K"], "K", 0, 1 << 16)
    whole_number(value["F"], "F", 0, 1 << 16)
    if not isinstance(value.get("scene", {}), dict) or not isinstance(value["recipe"], str):
        raise Damaged("a recipe or a scene of another form")


def data_in(about: Mapping[str, Any]) -> Data:
    """How the capture was read, as far as a description says it; without the capture's path."""
    return from_json(Data, {**about.get("data", {}), "path": ""}, "data")


DRAWN = ("resolution", "background", "near")
"""Settings of a capture that a scene was trained for: with others it looks different."""


def drawn_as(data: Data, about: Mapping[str, Any]) -> Data:
    """The settings of a capture where those of `DRAWN` that have their default are as a description
    says that the scene was trained."""
    own = data_in(about)
    asked = {f.name: getattr(data, f.name) != f.default for f in fields(Data) if f.name in DRAWN}
    return replace(data, **{name: getattr(own, name) for name in DRAWN if not asked[name]})


def world_in(about: dict[str, Any]) -> World:
    """The world that a description states."""
    x, y, z = (float(v) for v in about["world"]["shift"])
    return World(float(about["world"]["scale"]), (x, y, z))


def origin_in(about: Mapping[str, Any]) -> Vector:
    """The place in the capture's own frame that the positions of a file are relative to, as its
    description states it."""
    found = about.get("origin", [0.0, 0.0, 0.0])
    if not isinstance(found, list) or len(found) != 3:
        raise Damaged("an origin of another form")
    x, y, z = (number(value, "the origin", -FARTHEST, FARTHEST) for value in found)
    return x, y, z


def file_world(about: dict[str, Any]) -> World:
    """The world that a description states, for positions as the files beside it hold them."""
    return world_in(about).seen_from(origin_in(about))


def expect_world(trained: World, found: World) -> None:
    """Raises InputError unless the capture is read into the world that the scene was trained in, up
    to rounding."""
    pairs = [(trained.scale, found.scale), *zip(trained.shift, found.shift)]
    reach = max(1.0, *(abs(s) for s in trained.shift))
    if any(abs(a - b) > 1e-5 * (abs(a) if i == 0 else reach) for i, (a, b) in enumerate(pairs)):
        raise InputError(
            f"expected the capture in the world of the scene (scale {trained.scale:.6g}, shift {trained.shift}), found scale "
            f"{found.scale:.6g}, shift {found.shift}; use the capture, --split, --normalise and --max-views it was trained with"
        )


def read_settings(folder: Path) -> dict[str, Any]:
    """The settings in cfg_args of the result folder above an iteration's folder; empty without the
    file.

    The file is the text of a Python namespace, `Namespace(voxel_size=0.001, ...)`. Its values are
    parsed as literals and never evaluated; others (a path object, a call) are left out. Raises
    InputError for a file of another form.
    """
    path = folder.parent.parent / SETTINGS
    if not path.is_file():
        return {}
    with opening(path, budget.SETTINGS) as source:
        return parse_namespace(source.read().decode())


def positive(value: Any) -> float | None:
    """A finite number above 0 among the settings; None for anything else."""
    fits = isinstance(value, (int, float)) and not isinstance(value, bool) and 0 < value <= FARTHEST
    return float(value) if fits else None
