"""Runs for the tests of files: scenes in memory, and exports without a measurement."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from torch import Tensor

from scene_experts.data.settings import Data
from scene_experts.files import export as exporting
from scene_experts.files.anchors.data import AnchorData
from scene_experts.files.anchors.write import vertices
from scene_experts.files.formats.ply import write_vertices
from scene_experts.files.options import Options
from scene_experts.files.standard import Written
from scene_experts.training.clock import Clock
from scene_experts.training.config import RunConfig
from scene_experts.training.recipes import RECIPES
from scene_experts.training.run_folder import OpenRun, open_run, with_capture
from support.scenes import start_scene


def run_in_memory(recipe: str, step: int = 30_000) -> OpenRun:
    """The untrained scene of a recipe as a run of `step` iterations, without a folder."""
    cfg = RECIPES[recipe][1]
    return OpenRun(Path("nowhere"), RunConfig(cfg, Data(Path("nowhere"))), start_scene(recipe), step, Clock())


def export_run(
    run: Path, format: str, out: Path | None = None, data: Path | None = None, tell: Any = None, **options: Any
) -> list[Written]:
    """Export a run folder; nothing is measured unless `measure` says so."""
    opened = with_capture(open_run(run), data)
    more = {} if tell is None else {"tell": tell}
    return exporting.export(opened, format, out, replace(Options(measure=False), **options), **more)


def write_anchor_ply(
    path: Path, xyz: Tensor, offsets: Tensor, feature: Tensor, log_scaling: Tensor, levels: dict[str, Tensor] | None = None
) -> None:
    """Write anchors as Scaffold-GS does, or with levels as Octree-GS does."""
    columns = {"xyz": xyz, "offsets": offsets, "feature": feature, "log_scaling": log_scaling, **(levels or {})}
    write_vertices(path, vertices(AnchorData(columns, {}, None)))


def floats(**columns: Any) -> dict[str, np.ndarray]:
    """Columns of float32."""
    return {name: np.asarray(value, np.float32) for name, value in columns.items()}
