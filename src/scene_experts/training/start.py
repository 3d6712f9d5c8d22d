"""Where a training starts: from the points of its capture, or from denser ones."""

from __future__ import annotations

from dataclasses import replace

import torch

from scene_experts.data.capture import Capture
from scene_experts.data.dense import NoDenseStartError, start_densely
from scene_experts.data.settings import Data
from scene_experts.training.adjusted import adjust_to_tracks
from scene_experts.training.config import Train
from scene_experts.training.state import Training

ENOUGH = 26_000
"""Points of a capture with which a recipe does not start densely: twice what the sweep brings. With
13,633 (fox) it gains, with 74,177 (bonsai) it loses detail (results/default.md)."""


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
        return Training.start(cfg, capture, device, dtype)
    try:
        found = start_densely(capture, cfg.growth.max_anchors)
    except NoDenseStartError as error:
        if not by_recipe:
            raise
        training = Training.start(cfg, capture, device, dtype)
        training.computed = f"the capture's points; a plane sweep finds no denser ones: it needs {error.expected} and found {error.why}"
        return training
    training = Training.start(cfg, replace(capture, points=found.points), device, dtype)
    training.computed = found.describe() + ("; --init points starts from the capture's own" if by_recipe else "")
    return training
