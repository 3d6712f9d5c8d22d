"""Where refined poses start: the poses and points of the capture, adjusted to its tracks."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch

from scene_experts.core.types import Points
from scene_experts.data.tracks import read_tracks
from scene_experts.data.views import Capture
from scene_experts.geometry.bundle import adjust
from scene_experts.scene.poses import at_pose

WORTH, LEAST = 0.05, 0.02  # share of the median reprojection error that an adjustment must take off, and px


@dataclass(frozen=True)
class AdjustedCapture:
    """A capture whose training cameras and points fit its tracks, and what was done."""

    capture: Capture
    about: str


def adjust_to_tracks(capture: Capture) -> AdjustedCapture:
    """Return the capture with the poses of its training views, and its points, that agree best with
    its tracks (`geometry.bundle`). It stays as it is if it has no tracks or already agrees.

    Points of another file than the reconstruction's stay where they are.
    """
    tracks = read_tracks(capture, capture.train)
    if tracks is None:
        return AdjustedCapture(capture, "poses are refined by the photographs alone: the capture has no tracks")
    points, seen = tracks
    cameras = [capture.views[i].camera for i in capture.train]
    found = adjust(np.stack([camera.world_to_cam.double().numpy() for camera in cameras]), points, seen)
    if not found.observations:
        return AdjustedCapture(capture, "poses are refined by the photographs alone: no point is in the tracks of two training views")
    if not found.before - found.after > max(WORTH * found.before, LEAST):
        return AdjustedCapture(capture, f"the poses fit the capture's tracks: their median error is {found.before:.2f} px")
    moved = {camera.id: at_pose(camera, torch.from_numpy(pose)) for camera, pose in zip(cameras, found.poses)}
    adjusted = capture.with_cameras(lambda camera: moved.get(camera.id, camera))
    if capture.points is not None:
        adjusted = replace(adjusted, points=_move(capture.points, points, found.points))
    return AdjustedCapture(
        adjusted, f"poses and points adjusted to {found.observations:,} tracks: median error {found.before:.2f} -> {found.after:.2f} px"
    )


def _move(points: Points, before: np.ndarray, after: np.ndarray) -> Points:
    """Return the points, those that are among `before` [P, 3] at their places in `after`."""
    rows = {place.tobytes(): i for i, place in enumerate(before)}
    xyz = points.xyz.double().numpy().copy()
    for i, place in enumerate(xyz):
        if (row := rows.get(place.tobytes())) is not None:
            xyz[i] = after[row]
    return Points(torch.from_numpy(xyz), points.rgb)
