"""Result folders of the 3DGS family, written: point_cloud/iteration_N with the scene and our
description of it, cfg_args and cameras.json above it. `result_folder.py` reads them."""

from __future__ import annotations

import logging
from pathlib import Path
from typing import Any

from scene_experts.core.errors import InputError
from scene_experts.core.io import read_json, write_bytes, write_json
from scene_experts.core.plain import to_json
from scene_experts.data.settings import Data
from scene_experts.data.views import Capture, Vector, World
from scene_experts.files.cameras import write_cameras
from scene_experts.files.registry import Family, family_named
from scene_experts.files.result_folder import DESCRIPTION
from scene_experts.training.run_folder import OpenRun, capture_of

log: logging.Logger = logging.getLogger(__name__)


def write_result_folder(run: OpenRun, capture: Capture, out: Path | None = None) -> Path:
    """Write the result folder of the run's family (point_cloud/iteration_N, cfg_args) and
    cameras.json below `out`, the run by default.

    Returns the iteration's folder; `out` for a family without files of its own. Raises RunError
    when the disk is full.
    """
    out = out or run.path
    family = family_named(run.scene.traits.family)
    width = capture.views[0].camera.width
    folder = out if family is None else write_scene_folder(run, family, capture.world, out, width)
    origin = capture.world.local_origin(run.scene.extent)
    write_cameras(out / "cameras.json", capture, origin)
    if any(origin):
        log.warning("%s and cameras.json hold positions %s", folder, tell_origin(origin))
    return folder


def origin_of(run: OpenRun, world: World) -> Vector:
    """The place in the capture's own frame that files of a run are relative to: that of the file
    which it was opened from, else `World.local_origin`. world: of the run."""
    return run.lone.origin if run.lone is not None and run.lone.capture is not None else world.local_origin(run.scene.extent)


def origin_note(origin: Vector) -> dict[str, Any]:
    """The entry of a description about a local origin; empty where it is 0."""
    return {"origin": list(origin)} if any(origin) else {}


def tell_origin(origin: Vector) -> str:
    """Say what positions are relative to, for a terminal."""
    return f"relative to ({', '.join(f'{v:.0f}' for v in origin)}) of the capture's frame, because float32 cannot hold them otherwise"


def result_warnings(run: OpenRun) -> list[str]:
    """What other readers of the result folder get wrong about a run; empty in most cases."""
    family = family_named(run.scene.traits.family)
    return [] if family is None else family.warnings(run)


def write_scene_folder(run: OpenRun, family: Family, world: World, out: Path, width: int | None) -> Path:
    """Write point_cloud/iteration_N with the scene and its description, and cfg_args above it;
    return the iteration's folder. The description comes last: a folder that has it is complete.

    width: Of the views trained on, in px; None if it is unknown.
    """
    folder = out / "point_cloud" / f"iteration_{run.step}"
    origin = origin_of(run, world)
    about = family.describe(run, world) | trained_in(run) | origin_note(origin)
    settings = family.write(run, world.seen_from(origin), folder, about)
    if settings:
        every = settings | capture_settings(run.config.data, width)
        text = ", ".join(f"{name}={value!r}" for name, value in every.items())
        write_bytes(out / "cfg_args", f"Namespace({text})".encode())
    write_json(folder / DESCRIPTION, about)
    return folder


def width_in(path: Path) -> int | None:
    """Return the width in px of the first view of a cameras.json, or None if the file does not say
    it."""
    try:
        width = read_json(path, "list of views")[0]["width"]
    except (InputError, LookupError, TypeError):
        return None
    return width if type(width) is int and width > 0 else None


def capture_settings(data: Data, width: int | None = None) -> dict[str, Any]:
    """Return the settings for cfg_args that say where the capture is and how the published tools
    read it, as closely as their settings can express ours.

    source_path is the path that the run was given. resolution: -1 limits the width to 1600 px, 1,
    2, 4 and 8 divide the sides, other numbers are the width in px: `width`, that of the views
    trained on. Where it is unknown, -1 stands for a width that only the photographs tell. eval
    holds out every 8th view; with lod, from 1 to 49, the views 0 to lod instead.
    """
    kind, _, number = data.resolution.partition(":")
    held = data.split.removeprefix("first:")
    first = int(held) if held != data.split and held.isdecimal() else 0
    # NeRF-synthetic captures are white by default; the published tools recognise them by this file
    # too.
    synthetic = (data.path / "transforms_train.json").is_file()
    white = (data.background is None and synthetic) or data.background == (1.0, 1.0, 1.0)
    if kind in ("cap1600", "inria"):
        resolution = -1
    elif kind == "as-is":
        resolution = 1
    elif kind == "factor" and float(number) in (1, 2, 4, 8):
        resolution = int(float(number))
    else:
        resolution = width or -1
    return {
        "source_path": str(data.path),
        "images": data.images or (f"images_{number}" if kind == "inria" else "images"),
        "resolution": resolution,
        "white_background": white,
        "data_device": "cuda",
        "eval": data.split != "none",
        "lod": first - 1 if 2 <= first <= 50 else 0,
    }


def world_of(run: OpenRun) -> World:
    """The world that a run was trained in: from a description in its result folder, else from its
    capture."""
    if run.cameras is not None:
        return run.cameras.world
    data = trained_in(run)["data"]
    for path in sorted((run.path / "point_cloud").glob(f"iteration_*/{DESCRIPTION}"), key=lambda p: p.stat().st_mtime, reverse=True):
        try:
            found = read_json(path, "scene description")
            if found["data"] == data:
                x, y, z = (float(v) for v in found["world"]["shift"])
                return World(float(found["world"]["scale"]), (x, y, z))
        except (InputError, KeyError, TypeError, ValueError):
            continue  # the capture says it too
    capture = capture_of(run)
    capture.images.close()
    return capture.world


def trained_in(run: OpenRun) -> dict[str, Any]:
    """The entries of a description about the training: recipe and reading of the capture, without
    the capture's path."""
    plain = to_json(run.config)
    del plain["data"]["path"]
    return {"train": plain["train"], "data": plain["data"]}
