"""A run folder: what a training leaves behind, and how the other commands open it.

RUN/config.json                      recipe, numbers, capture, command, versions
RUN/metrics.jsonl                    one line per logged iteration
RUN/checkpoints/ckpt_NNNNNN.safetensors
RUN/point_cloud/iteration_N/, RUN/cameras.json      the Scaffold-GS layout, in the capture's own frame
RUN/previews/, RUN/test/, RUN/results.json, RUN/per_view.json
"""

from __future__ import annotations

import platform
from dataclasses import dataclass, replace
from pathlib import Path

import torch

import scene_experts
from scene_experts import checkpoint
from scene_experts.config import Data, RunConfig, Train, from_json, to_json
from scene_experts.data import capture as captures
from scene_experts.data.capture import Capture
from scene_experts.errors import InputError
from scene_experts.io import read_json, write_json
from scene_experts.scene.anchors import AnchorScene
from scene_experts.train import scene_from, to_device

FORMAT = 1


@dataclass(frozen=True)
class OpenRun:
    """A trained scene with its capture and configuration."""

    path: Path
    config: RunConfig
    cfg: Train  # scaled
    scene: AnchorScene
    step: int
    seconds: float  # of training


def versions() -> dict[str, str]:
    """What the run was made with."""
    return {
        "scene-experts": scene_experts.__version__,
        "torch": torch.__version__,
        "python": platform.python_version(),
        "machine": platform.machine(),
    }


def prepare(out: Path, config: RunConfig, resume: bool, overwrite: bool = False) -> None:
    """Make `out` ready for a run: refuses to write over another one, and to resume a run of another recipe or capture."""
    path = out / "config.json"
    if overwrite and not resume:
        for old in [*(out / "checkpoints").glob("ckpt_*.safetensors"), out / "results.json", out / "per_view.json", path]:
            old.unlink(missing_ok=True)
    if path.exists():
        found = read_config(out)
        if not resume and checkpoint.latest(out / "checkpoints") is not None:
            raise InputError(
                f"expected a new or empty run folder, found checkpoints in {out}; add --resume to go on, --overwrite to begin anew, or choose another --out"
            )
        if resume and found.train.recipe != config.train.recipe:
            raise InputError(
                f"expected a run of '{config.train.recipe}' to resume in {out}, found one of '{found.train.recipe}'; "
                f"use `train {found.train.recipe}` or another --out"
            )
        if resume and replace(found.data, path=Path()) != replace(config.data, path=Path()):
            raise InputError(
                f"expected the capture settings the run in {out} began with, found other ones; use the same --resolution, --split, ..."
            )
    write_json(path, {"format": FORMAT, **to_json(config)})


def read_config(run: Path) -> RunConfig:
    """The configuration of a run folder. Raises InputError when it is none."""
    if not (run / "config.json").is_file():
        raise InputError(f"expected a run folder with config.json at {run}, found none; give the folder that `train --out` wrote")
    value = read_json(run / "config.json", "run configuration")
    if not isinstance(value, dict) or value.pop("format", None) != FORMAT:
        raise InputError(f"expected a run configuration of format {FORMAT} in {run}, found another; train it again with this version")
    return from_json(RunConfig, value)


def load_capture(data: Data, seed: int = 0) -> Capture:
    """The capture that `data` describes."""
    return captures.load(
        data.path,
        images=data.images,
        resolution=data.resolution,
        split=data.split,
        missing=data.missing,
        normalise=data.normalise,
        init=data.init,
        max_views=data.max_views,
        ignore_principal_point=data.ignore_principal_point,
        background=data.background,
        seed=seed,
    )


def open_run(run: Path, device: str = "cpu", step: int | None = None) -> OpenRun:
    """The newest whole checkpoint of a run (or the one at `step`). Raises InputError when there is none."""
    config = read_config(run)
    folder = run / "checkpoints"
    path = checkpoint.latest(folder) if step is None else folder / f"ckpt_{step:06d}.safetensors"
    if path is None or not path.is_file():
        raise InputError(
            f"expected a checkpoint in {folder}, found none{'' if step is None else f' at step {step}'}; train first, or use --resume"
        )
    tensors, meta = checkpoint.load(path)
    checkpoint.expect(meta, recipe=config.train.recipe)
    cfg = config.train.scaled()
    scene = to_device(scene_from(cfg, tensors, meta), device)
    scene.eval()
    return OpenRun(run, config, cfg, scene, int(meta["step"]), float(meta["seconds"]))
