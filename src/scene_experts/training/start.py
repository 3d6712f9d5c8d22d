"""Where a training starts: from a checkpoint, from another run, from the points of its capture, or
from denser ones."""

from __future__ import annotations

import logging
from dataclasses import replace
from pathlib import Path

import torch

from scene_experts.core.errors import InputError
from scene_experts.data.capture import Capture
from scene_experts.data.dense import NoDenseStartError, start_densely
from scene_experts.data.far import add_far_points
from scene_experts.data.settings import Data
from scene_experts.training.adjusted import adjust_to_tracks
from scene_experts.training.config import RunConfig, Train, find_unused
from scene_experts.training.early import is_shrunk
from scene_experts.training.init_from import start_from
from scene_experts.training.job import Job, last_iteration
from scene_experts.training.recipes import RECIPES
from scene_experts.training.state import Training, resume

log: logging.Logger = logging.getLogger(__name__)

MUCH = 0.02  # of --rate
ENOUGH = 26_000
"""Points of a capture with which a recipe does not start densely: twice what the sweep brings. With
13,633 (fox) it gains, with 74,177 (bonsai) it loses detail (results/default.md)."""


def begin(cfg: Train, run: Job, capture: Capture, folder: Path | None) -> Training:
    """Start a training, or restore it from the newest whole checkpoint in `folder`. `cfg` must be
    scaled. Raises InputError as `loop.train`."""
    training = resume(cfg, folder, run.device) if run.options.resume and folder else None
    if training and training.capture_id not in ("", capture.fingerprint()):
        raise InputError(f"expected the capture that this run was trained on, found other views in {capture.root}; give the right --data")
    if training:
        capture.expect_poses(training.poses, folder and folder.parent)
    if training and training.chosen not in (None, capture.chosen()):
        raise InputError("expected the training views that this run began with, found others; restore the file of --views, or train anew")
    if training is None and run.config.init_from is not None:
        training = start_from(cfg, run.config.init_from, capture, run.device, run.config)
        if run.config.data.init == "dense":
            log.warning("--init dense has no effect with --init-from, whose scene is there already; leave it out")
        if training.step >= last_iteration(cfg, run):
            found = f"found {run.config.stop_at}; give a larger number or leave it out"
            raise InputError(f"expected --stop-at above {training.step}, where the run of --init-from ended, {found}")
    training = training or start(cfg, run.config.data, capture, run.device, run.dtype)
    usual = RECIPES[cfg.recipe][1] if cfg.recipe in RECIPES else None
    if unused := find_unused(run.config.train, usual):
        log.warning("these options have no effect with this recipe and its other options: %s; leave them out", ", ".join(unused))
    if idle := find_idle(run.config, capture, usual):
        log.warning("these options have no effect here: %s", "; ".join(idle))
    if cfg.rate > MUCH:
        log.warning("--rate %g makes bits count so much that little may be left of the scene; 0.0005 to 0.002 is usual", cfg.rate)
    training.capture_id, training.poses, training.chosen = capture.fingerprint(), capture.poses(), capture.chosen()
    if uses_depth(cfg, capture):
        told = sum(capture.views[i].depth is not None for i in capture.train)
        about = f"the depth maps of {told} of {len(capture.train)} training photographs count in the loss; --loss.depth 0 leaves them out"
        training.computed = "; ".join(part for part in (training.computed, about) if part)
    training.scene.set_training_cameras([capture.views[i].camera for i in capture.train])
    return training


def find_idle(config: RunConfig, capture: Capture, usual: Train | None) -> list[str]:
    """Return the flags that were given, differ from the recipe (`usual`) and have no effect on this
    capture, with the reason."""
    cfg, found = config.train, []
    shown = [capture.views[i] for i in capture.train]
    if cfg.loss.depth not in (0, usual and usual.loss.depth) and all(view.depth is None for view in shown):
        found.append("--loss.depth (no training photograph has a depth map)")
    if cfg.half_until not in (0, usual and usual.half_until) and not any(is_shrunk(view.camera) for view in shown):
        found.append("--half-until (all photographs are smaller)")
    if config.stop_at is not None and config.stop_at > cfg.iterations:
        found.append(f"--stop-at ({cfg.iterations:,} iterations end before)")
    return found


def uses_depth(cfg: Train, capture: Capture) -> bool:
    """Whether depth maps count in the loss."""
    return cfg.loss.depth > 0 and any(capture.views[i].depth is not None for i in capture.train)


def start(cfg: Train, data: Data, capture: Capture, device: str, dtype: torch.dtype) -> Training:
    """Start a training from the capture's points, or with --init dense, and with few views where the
    recipe asks for it, from those of `data.dense`. Refined poses start where the capture's tracks
    put them. `cfg` must be scaled. Raises InputError as `loop.train`."""
    if not cfg.refine_poses:
        return _start(cfg, data, capture, device, dtype)
    adjusted = adjust_to_tracks(capture)
    training = _start(cfg, data, adjusted.capture, device, dtype)
    assert training.scene.poses is not None
    given, found = ([of.views[i].camera for i in capture.train] for of in (capture, adjusted.capture))
    training.scene.poses.begin_at(given, found)
    training.computed = "; ".join(part for part in (training.computed, adjusted.about) if part)
    return training


def _start(cfg: Train, data: Data, capture: Capture, device: str, dtype: torch.dtype) -> Training:
    few = len(capture.train) <= cfg.dense_views and (capture.points is None or len(capture.points.xyz) < ENOUGH)
    by_recipe = few and data.init == "auto" and data.points is None and not capture.random_points
    if data.init != "dense" and not by_recipe:
        return _start_far(cfg, data, capture, device, dtype)
    try:
        found = start_densely(capture, cfg.growth.max_anchors)
    except NoDenseStartError as error:
        if not by_recipe:
            raise
        training = _start_far(cfg, data, capture, device, dtype)
        about = f"the capture's points; a plane sweep finds no denser ones: it needs {error.expected} and found {error.why}"
        training.computed = "; ".join(part for part in (about, training.computed) if part)
        return training
    training = Training.start(cfg, replace(capture, points=found.points), device, dtype)
    training.computed = found.describe() + ("; --init points starts from the capture's own" if by_recipe else "")
    return training


def _start_far(cfg: Train, data: Data, capture: Capture, device: str, dtype: torch.dtype) -> Training:
    """Start a training from the capture's points, and from points far away where the recipe asks
    for them. Then rows are created around the former only."""
    wanted = cfg.far_points > 0 and data.init == "auto" and not capture.random_points
    found = add_far_points(capture, cfg.far_points) if wanted else None
    if found is None:
        return Training.start(cfg, capture, device, dtype)
    training = Training.start(cfg, replace(capture, points=found.points), device, dtype)
    training.box = found.box
    training.computed = f"{found.describe()}; --init points starts from the capture's own alone"
    return training
