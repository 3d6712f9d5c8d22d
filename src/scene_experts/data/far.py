"""Points far away, for the parts of the photographs that show none of a capture's points: sky, or
the room behind what was photographed.

Structure from motion finds no points there. Without any, a training explains what it sees there by
blobs before the cameras that see it, which hide the scene from others. Far away a scene needs no
detail, so nothing is added there later (results/default.md).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image
from torch import Tensor

from scene_experts.core.types import Points
from scene_experts.data.dense.cells import SizedPoints, fuse, thin
from scene_experts.data.projection import project
from scene_experts.data.views import Capture, Frame, View

CELLS = 25  # along the longer side of a picture; each gets at most one point
REACH = 2  # cells around one in which a point of the capture says that it is no hole
FEWEST = 20  # points of a view that tell its farthest depth
FARTHEST = 0.99  # quantile of their depths that counts as the farthest: some are wrong
OUTSIDE = 0.005  # quantile of the coordinates of points, at both ends, that are outside of the box around them: some are wrong
PART = 0.1  # largest number of far points, in those of the capture


@dataclass(frozen=True)
class FarPoints:
    """A capture's points with those far away."""

    points: Points  # trained world; the capture's own come first
    added: int  # points far away
    share: float  # of the pictures that shows no point, 0 to 1
    box: tuple[float, ...]  # low and high corner (x, y, z, x, y, z) of what has points of the capture, with room around

    def describe(self) -> str:
        """Return one line for the user."""
        return f"{self.added:,} points far away, for the {100 * self.share:.0f} % of the pictures where the capture has none"


def add_far_points(capture: Capture, times: float) -> FarPoints | None:
    """Return the points of a capture with those far away; None where there are none to add.

    times: Their distance, in the farthest depth of the points that a photograph shows. From what
    surrounds a scene, cameras on its other side must not be before them.

    Only photographs with such parts are read. Raises InputError if one cannot be.
    """
    if capture.points is None or len(capture.points.xyz) == 0:
        return None
    own = capture.points
    parts, holes, cells = [], 0, 0
    for index in capture.train:
        view = capture.views[index]
        hole, depth = find_holes(view, own.xyz)
        cells += hole.size
        if depth is not None and hole.any():
            found = _lift(view, hole, depth * times, capture.frame(index))
            holes += len(found)
            parts.append(found)
    if not holes:
        return None
    cloud = fuse(SizedPoints.join(parts), 1.0)
    most = max(1, int(PART * len(own.xyz)))
    if len(cloud) > most:
        cloud, _ = thin(cloud, most)
    far = torch.from_numpy(cloud.xyz).to(own.xyz), torch.from_numpy(cloud.rgb.clip(0, 255).round().astype(np.uint8)).to(own.rgb)
    return FarPoints(Points(torch.cat([own.xyz, far[0]]), torch.cat([own.rgb, far[1]])), len(cloud), holes / cells, find_box(own.xyz))


def find_box(points: Tensor) -> tuple[float, ...]:
    """Return the low and the high corner of a box around the points [n, 3], but for those outside of
    quantiles of their coordinates. It leaves room on each side as wide as its widest."""
    xyz = points.double().numpy()
    low, high = np.quantile(xyz, OUTSIDE, axis=0), np.quantile(xyz, 1 - OUTSIDE, axis=0)
    room = float((high - low).max())
    return tuple(float(f"{side:.4g}") for side in (*(low - room), *(high + room)))  # the same on all processors


def find_holes(view: View, xyz: Tensor) -> tuple[NDArray[np.bool_], float | None]:
    """Return the cells [rows, columns] of a picture that show none of the points [n, 3], nor do
    those around them, and the farthest depth that it shows; None if too few points say it."""
    camera = view.camera
    longer = max(camera.width, camera.height)
    columns, rows = (max(1, round(CELLS * side / longer)) for side in (camera.width, camera.height))
    u, v, z = (found.numpy() for found in project(xyz, camera))
    ahead = z > 0
    z = z[ahead]
    column = np.floor(u[ahead] * (columns / camera.width))
    row = np.floor(v[ahead] * (rows / camera.height))
    seen = (column >= 0) & (column < columns) & (row >= 0) & (row < rows)
    if int(seen.sum()) < FEWEST:
        return np.zeros((rows, columns), dtype=np.bool_), None
    shown = np.zeros((rows + 2 * REACH, columns + 2 * REACH), dtype=np.bool_)
    row, column = row[seen].astype(np.int64), column[seen].astype(np.int64)
    for down in range(2 * REACH + 1):
        for right in range(2 * REACH + 1):
            shown[row + down, column + right] = True
    return ~shown[REACH:-REACH, REACH:-REACH], float(np.quantile(z[seen], FARTHEST))


def _lift(view: View, hole: NDArray[np.bool_], depth: float, frame: Frame) -> SizedPoints:
    """Return a point at `depth` in the middle of each cell that is a hole and that no mask leaves
    out, with the photograph's colour there."""
    camera, (rows, columns) = view.camera, hole.shape
    if frame.mask is not None:
        counts = Image.fromarray((frame.mask.numpy() > 0).astype(np.uint8) * 255).resize((columns, rows), Image.Resampling.BOX)
        hole = hole & (np.asarray(counts) == 255)
    rgb = np.asarray(Image.fromarray(frame.rgb.numpy()).resize((columns, rows), Image.Resampling.BOX)).astype(np.float64)
    row, column = np.nonzero(hole)
    u, v = (column + 0.5) * (camera.width / columns), (row + 0.5) * (camera.height / rows)
    local = np.stack(((u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, np.ones(len(u))), 1) * depth
    pose = camera.world_to_cam.double().numpy()
    away = local - pose[:3, 3]
    xyz = away[:, :1] * pose[0, :3] + away[:, 1:2] * pose[1, :3] + away[:, 2:] * pose[2, :3]
    edge = depth / float(camera.fx) * camera.width / columns
    return SizedPoints(xyz, rgb[row, column], np.full(len(u), edge), np.ones(len(u)))
