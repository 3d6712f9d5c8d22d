"""Scenes to convert and to look at: run folders, and files and result folders without a run."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

from scene_experts.core.errors import InputError
from scene_experts.core.reading import budget
from scene_experts.core.reading.source import guarding
from scene_experts.data.settings import Data
from scene_experts.files.gaussians.read import beside
from scene_experts.files.importing import owner
from scene_experts.files.registry import format_named, format_names, scene_file
from scene_experts.files.result_folder import DESCRIPTION, is_result, read_description
from scene_experts.scene.fit import restore_foreign
from scene_experts.training import run_folder
from scene_experts.training.capture_place import Lone
from scene_experts.training.clock import Clock
from scene_experts.training.config import RunConfig
from scene_experts.training.run_folder import OpenRun

_CARRIED = {"recipe": str, "step": int, "capture": str}  # entries of a note that stay true of a converted file


def open_scene(path: Path, device: str = "cpu", step: int | None = None, data: Path | None = None) -> OpenRun:
    """Open a run folder, or a file, folder of SOG or result folder as a run that is on no disk.

    step: of a run its checkpoint, of a result folder its iteration; None: the newest. data: the
    capture, if a run's has moved, or that of a file; a file without one gets cameras without
    photographs (`OpenRun.cameras`). Raises InputError for what cannot be read.
    """
    is_run = (path / "config.json").is_file() or (path / "checkpoints").is_dir()
    if not is_run and not (is_result(path) or scene_file(path).is_file()):
        run = path / "run"  # of a folder that `make` wrote
        raise InputError(
            f"expected a run folder with config.json, or a file or result folder of a scene, at {path}, found none; "
            f"{f'give the run {run}' if (run / 'config.json').is_file() else 'check the path'}"
        )
    if is_run:
        return run_folder.with_capture(run_folder.open_run(path, device, step), data)
    family, found = owner(path, step)
    capture = None if data is None else run_folder.named(Data(data))
    with guarding(found, budget.HEAD, "scene"):
        read = family.read(found, capture, step)
        scene = restore_foreign(read.cfg.scaled_scene(), read.tensors, {"step": read.step, **read.meta})
    lone = Lone(found, name_of(path), read.capture if data is None else None, read.origin, carried_note(found))
    config = RunConfig(read.cfg, read.data, f"open {path.name}", versions=run_folder.versions())
    home = path if path.is_dir() else path.parent
    return replace(OpenRun(home, config, scene.to(device), read.step, Clock()), lone=lone)


def name_of(path: Path) -> str:
    """The name of a scene, from that of its file without the suffix of a format, or of its folder."""
    if path.is_dir():
        return path.resolve().name or "scene"
    suffixes = [format_named(name).suffix for name in format_names()]
    known = max((suffix for suffix in suffixes if suffix and path.name.lower().endswith(suffix)), key=len, default=path.suffix)
    return path.name[: len(path.name) - len(known)] or "scene"


def carried_note(found: Path) -> dict[str, Any]:
    """What the description beside a file, or in an iteration's folder, says about the training."""
    folder = found if found.is_dir() else found.parent
    about = (read_description(folder) if (folder / DESCRIPTION).is_file() else None) or beside(found)
    return {name: about[name] for name, kind in _CARRIED.items() if type(about.get(name)) is kind}
