"""Scenes written with their networks: files of their own family, and the result folder that a training leaves for other tools."""

from __future__ import annotations

from dataclasses import fields, replace
from pathlib import Path
from typing import Any

from scene_experts.core.errors import InputError
from scene_experts.core.io import read_json, write_bytes, write_json
from scene_experts.core.plain import to_json
from scene_experts.data.settings import Data
from scene_experts.data.views import Capture, World
from scene_experts.files.cameras import write_cameras
from scene_experts.files.measure import capture_if_there, cost
from scene_experts.files.options import Options
from scene_experts.files.registry import Family, family_named, formats_of
from scene_experts.files.work import Work, Written, file_path, flag
from scene_experts.training.run_folder import OpenRun, capture_of

DESCRIPTION = "scene.json"  # in a result folder


def write_result_folder(run: OpenRun, capture: Capture, out: Path | None = None) -> Path:
    """Write the result folder of the run's family (point_cloud/iteration_N, cfg_args) and
    cameras.json below `out`, the run by default.

    Returns the iteration's folder; `out` for a family without files of its own. Raises RunError
    when the disk is full.
    """
    out = out or run.path
    family = family_named(run.scene.traits.family)
    folder = out if family is None else write_scene_folder(run, family, capture.world, out)
    write_cameras(out / "cameras.json", capture)
    return folder


def result_warnings(run: OpenRun) -> list[str]:
    """What other readers of the result folder get wrong about a run; empty in most cases."""
    family = family_named(run.scene.traits.family)
    return [] if family is None else family.warnings(run)


def world_of(run: OpenRun) -> World:
    """The world that a run was trained in: from a description in its result folder, else from its capture."""
    data = _trained(run)["data"]
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


def _trained(run: OpenRun) -> dict[str, Any]:
    """The entries of a description about the training: recipe and reading of the capture, without
    the capture's path."""
    plain = to_json(run.config)
    del plain["data"]["path"]
    return {"train": plain["train"], "data": plain["data"]}


def expect_unused(options: Options, format: str) -> None:
    """Raises InputError for options of standard files with a format that is none."""
    for f in fields(options):
        if f.name != "measure" and getattr(options, f.name) != f.default:
            raise InputError(f"expected {flag(f.name)} with a standard file (ply, spz, html, ...), found --format {format}; leave it out")


def export_scene(work: Work, out: Path | None) -> Written:
    """Write the run's scene as it is, in a format of its own family."""
    run, format, traits = work.run, work.format, work.run.scene.traits
    family = family_named(format.family)
    if traits.family != format.family or family is None:
        own = formats_of(traits.family) if family_named(traits.family) is not None else {}
        raise InputError(
            f"expected a scene of {format.family} for --format {work.name}, found {traits.rows} (a run of '{run.config.train.recipe}'); "
            f"use --format {next(iter(own), 'ply')}"
        )
    expect_unused(work.options, work.name)
    world = world_of(run)
    if format.is_folder:
        return _export_folder(work, family, world, out or run.path)
    path = file_path(run.path, work.name, format, out)
    about = family.describe(run, world) | _trained(run)
    detail = format.write(path, family.contents(run, world, about), {})  # type: ignore[misc]
    rows, size = len(run.scene.positions), path.stat().st_size
    said = f"{rows:,} {traits.rows}, {size / 1e6:.2f} MB with networks" + (f", {detail}" if detail is not None else "")
    written = Written(path, size, rows, (f"wrote {path}", said))
    if not work.options.measure or format.read is None:
        return written
    with capture_if_there(run, needed=False) as capture:
        found = cost(run, lambda: {"file": family.scene(run, format.read(path), world)}, capture, work.rasterize, work.tell)  # type: ignore[misc]
    return replace(written, lines=(*written.lines, *found.lines), psnr=found.psnr)


def _export_folder(work: Work, family: Family, world: World, out: Path) -> Written:
    run = work.run
    folder = write_scene_folder(run, family, world, out)
    if out != run.path and (run.path / "cameras.json").is_file():
        write_bytes(out / "cameras.json", (run.path / "cameras.json").read_bytes())
    size, rows = sum(p.stat().st_size for p in folder.iterdir()), len(run.scene.positions)
    said = f"{rows:,} {run.scene.traits.rows}, {size / 1e6:.2f} MB with networks, in the capture's own frame"
    return Written(folder, size, rows, (f"wrote {folder}", said, *family.warnings(run)))


def write_scene_folder(run: OpenRun, family: Family, world: World, out: Path) -> Path:
    """Write point_cloud/iteration_N with the scene and its description, and cfg_args above it; return
    the iteration's folder. The description comes last: a folder that has it is complete."""
    folder = out / "point_cloud" / f"iteration_{run.step}"
    about = family.describe(run, world) | _trained(run)
    settings = family.write(run, world, folder, about)
    if settings:
        every = settings | capture_settings(run.config.data)
        text = ", ".join(f"{name}={value!r}" for name, value in every.items())
        write_bytes(out / "cfg_args", f"Namespace({text})".encode())
    write_json(folder / DESCRIPTION, about)
    return folder


def capture_settings(data: Data) -> dict[str, Any]:
    """Return the settings for cfg_args that say where the capture is and how the published tools
    read it, as closely as their settings can express ours.

    source_path is the path that the run was given. resolution: -1 limits the width to 1600 px, 1, 2,
    4 and 8 divide the sides, other numbers are the width in px. eval holds out every 8th view; with
    lod, from 1 to 49, the views 0 to lod instead.
    """
    kind, _, number = data.resolution.partition(":")
    held = data.split.removeprefix("first:")
    first = int(held) if held != data.split and held.isdecimal() else 0
    # NeRF-synthetic captures are white by default; the published tools recognise them by this file too.
    synthetic = (data.path / "transforms_train.json").is_file()
    white = (data.background is None and synthetic) or data.background == (1.0, 1.0, 1.0)
    divided = kind == "factor" and float(number) in (1, 2, 4, 8)
    return {
        "source_path": str(data.path),
        "images": data.images or (f"images_{number}" if kind == "inria" else "images"),
        "resolution": 1 if kind == "as-is" else int(float(number)) if divided or kind == "longest" else -1,
        "white_background": white,
        "data_device": "cuda",
        "eval": data.split != "none",
        "lod": first - 1 if 2 <= first <= 50 else 0,
    }
