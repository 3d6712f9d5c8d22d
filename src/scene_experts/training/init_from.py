"""Trainings that start from the scene of another run (`--init-from`)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch

from scene_experts.core import checkpoint
from scene_experts.core.errors import InputError, few
from scene_experts.core.fields import flag_of
from scene_experts.core.plain import MOST_DIFFERENCES, differences, to_json
from scene_experts.core.reading.budget import RUN
from scene_experts.core.reading.source import guarding
from scene_experts.data.capture import Capture
from scene_experts.data.settings import Data
from scene_experts.scene import SceneConfig
from scene_experts.scene.exposure import Exposures
from scene_experts.scene.fit import restore_foreign
from scene_experts.scene.poses import Poses
from scene_experts.training.config import RunConfig, Train
from scene_experts.training.run_folder import read_config
from scene_experts.training.state import Training, new_exposures, new_poses


def start_from(cfg: Train, run: Path, capture: Capture, device: str, now: RunConfig) -> Training:
    """Create a training of `cfg`, which must be scaled, that starts from the scene of a run
    folder, at its iteration.

    The scene has its averaged weights, if there are any. The optimiser, the statistics and the
    order of the views start anew; rows are created where that run created them.

    now: The configuration of the new run, with the settings before scaling.

    Raises InputError if the run has no checkpoint, another recipe, capture, world or scene, or
    as many iterations as `cfg` already, or if `cfg` would put its scene back into a phase that
    it has left, such as the dense warm-up.
    """
    found = checkpoint.newest(run / "checkpoints")
    if found is None:
        raise InputError(f"expected a trained run for --init-from at {run}, found none; give the folder that `train --out` wrote")
    tensors, meta = found
    if (other := meta.get("recipe")) != cfg.recipe:
        raise InputError(
            f"expected --init-from a run of '{cfg.recipe}', found {run} of '{other}'; train '{other}', or leave --init-from out"
        )
    before = read_config(run)
    _check(cfg, run, before, meta, capture, now)
    torch.manual_seed(cfg.seed)
    try:
        with guarding(run, RUN):
            scene = restore_foreign(cfg.scene, tensors, meta, averaged=True).to(device)
            scene.forget_rounding()
            scene.exposures = new_exposures(cfg, capture, Exposures.restore(tensors))
            scene.poses = new_poses(cfg, capture, Poses.restore(tensors))
            training = Training(cfg, scene.to(device))
    except InputError as error:
        if other := _changes(before.train.scene, now.train.scene, "scene"):
            raise InputError(f"expected a scene of the kind that {run} of --init-from has{other}; use the flags of that run") from error
        raise
    training.step, training.box = int(meta["step"]), tuple(meta.get("box", ()))
    return training


def _check(cfg: Train, run: Path, before: RunConfig, meta: Mapping[str, Any], capture: Capture, now: RunConfig) -> None:
    """Raise InputError if a training of `cfg` cannot go on from the checkpoint of a run."""
    if meta.get("capture", "") not in ("", capture.fingerprint()):
        other = _changes(replace(before.data, path=Path(), views=None), replace(now.data, path=Path(), views=None))
        raise InputError(
            f"expected the views that {run} of --init-from was trained on, found others in {capture.root}{other}; "
            "use its --data, --resolution, --split and --max-views"
        )
    if before.data.normalise != now.data.normalise:  # its anchors lie in another world
        raise InputError(
            f"expected --normalise {before.data.normalise}, the world that {run} of --init-from was trained in, "
            f"found {now.data.normalise}; give --normalise {before.data.normalise}"
        )
    capture.expect_poses(meta.get("poses"), run)
    if not int(meta["step"]) < cfg.iterations or int(meta["step"]) % cfg.batch:
        more = f"above {meta['step']}" if int(meta["step"]) >= cfg.iterations else f"and a --batch that divides {meta['step']}"
        raise InputError(f"expected --iterations {more}, where the run of --init-from ended, found {cfg.iterations}; change it")
    check_phases(cfg, before.train.scaled_scene(), int(meta["step"]))


def _changes(before: Data | SceneConfig, now: Data | SceneConfig, where: str = "") -> str:
    """Return ": SETTING was A, is now B" for the settings that differ, or an empty string."""
    found = differences(to_json(before), to_json(now), where)
    return f": {few(found, MOST_DIFFERENCES)}" if found else ""


def check_phases(cfg: Train, before: SceneConfig, step: int) -> None:
    """Raise InputError if a scene that was trained with `before` until iteration `step` has left a
    phase in which `cfg` still is then.

    Both must be scaled. In an earlier phase, other networks, levels or harmonics draw the scene
    than those that were trained last.
    """
    left = {place for place, last in before.phases().items() if step > last}
    for place, last in cfg.scene.phases().items():
        if place in left and step <= last:
            raise InputError(
                f"expected the phase of {flag_of(f'scene.{place}')} to end before iteration {step}, because the run of --init-from "
                f"has left it, "
                f"found one that lasts until iteration {last}; give fewer --iterations or a smaller value"
            )
