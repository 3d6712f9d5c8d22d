"""A mesh of a trained scene: the training views are drawn, and their depths fused."""

from __future__ import annotations

import logging
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from scene_experts.core.errors import InputError
from scene_experts.data.far import find_box
from scene_experts.data.views import Capture
from scene_experts.files.measure import Painter, Tell
from scene_experts.files.mesh.fuse import DepthView, Points, clean, find_blocks, fuse, see_points
from scene_experts.files.mesh.surface import Mesh, colour, find_surface
from scene_experts.files.select import parse_crop
from scene_experts.render import Rasterizer
from scene_experts.training.run_folder import OpenRun

log: logging.Logger = logging.getLogger(__name__)
MOST_VIEWS = 200  # evenly chosen
INNER = (0.02, 0.98)  # quantiles of the points seen, along each axis, that the mesh reaches to without --crop
SAMPLED = 4  # every nth pixel decides where they are


@dataclass(frozen=True)
class MeshTask:
    """What a mesh is made of."""

    run: OpenRun
    capture: Capture
    cells: int
    """Voxels along the longest side of the box."""
    crop: str | None
    rasterize: Rasterizer | None
    tell: Tell


@torch.no_grad()
def make_mesh(task: MeshTask) -> tuple[Mesh, dict[str, Any]]:
    """Return the mesh of a run in the capture's own frame, and how it was made.

    Raises InputError where the views show no surface, and for a capture without training views.
    """
    views = draw_views(task)
    points = np.concatenate([see_points(view, SAMPLED) for view in views] or [np.zeros((0, 3))])
    inside = _inside(task, points)
    if not inside.any():
        where = " inside --crop" if task.crop else ""
        raise InputError(f"expected opaque surfaces{where} in the training views, found none; train longer, or correct --crop")
    if not task.crop and not inside.all():
        log.warning(
            "%.0f %% of what the views show lies farther from the capture's points than their width, and is left out as a background; "
            "--crop chooses otherwise",
            100 * float(1 - inside.mean()),
        )
    points = points[inside]
    low, high = (np.min(points, 0), np.max(points, 0)) if task.crop else np.quantile(points, INNER, axis=0)
    voxel = float((high - low).max()) / task.cells
    every = np.concatenate([see_points(view) for view in views])
    every = every[((every >= low) & (every <= high)).all(1) & _inside(task, every)]
    task.tell("fusing depths", 0, 1)
    volume = fuse(views, find_blocks(every, low, voxel), low, voxel, lambda done, total: task.tell("fusing depths", done, total))
    vertices, faces = find_surface(volume, len(views))
    if not len(faces):
        raise InputError("expected a surface in the depths of the training views, found none; choose more voxels (--cells) or train longer")
    mesh = Mesh(_to_input(task.capture, vertices), faces, colour(vertices, views, voxel))
    return mesh, {"views": len(views), "voxel": voxel / task.capture.world.scale, "cells": task.cells, "crop": task.crop}


def draw_views(task: MeshTask) -> list[DepthView]:
    """Draw the training views of a run."""
    run, capture = task.run, task.capture
    if not capture.train:
        raise InputError("expected training views to make a mesh from, found none in the capture; choose another --split")
    painter = Painter.of(run.scene, run.step, task.rasterize, run.config.train.antialias)
    chosen = capture.train[:: -(-len(capture.train) // MOST_VIEWS)]
    background, views = torch.tensor(capture.background), []
    for i, index in enumerate(chosen):
        camera = capture.views[index].camera
        drawn = painter.rasterize(painter.gaussians(camera), camera, background)
        depth, alpha = drawn.depth.numpy(), drawn.alpha.numpy()
        views.append(DepthView(camera, clean(depth, alpha), drawn.image.clamp(0, 1).numpy()))
        task.tell("drawing depths", i + 1, len(chosen))
    return views


def _inside(task: MeshTask, points: Points) -> NDArray[np.bool_]:
    """Which points [N, 3] of the trained world --crop keeps, [N]. Without it, those that a training
    with points far away draws there are left out: they are a background, not a surface."""
    if not task.crop:
        capture = task.capture
        if not task.run.config.train.far_points or capture.points is None or capture.random_points:
            return np.ones(len(points), np.bool_)
        low, high = np.reshape(find_box(capture.points.xyz), (2, 3))
        return np.asarray(((points >= low) & (points <= high)).all(1), dtype=np.bool_)
    return parse_crop(task.crop).contains(torch.from_numpy(_to_input(task.capture, points)), task.capture).numpy()


def _to_input(capture: Capture, points: Points) -> Points:
    return capture.world.to_input(torch.from_numpy(points)).numpy()
