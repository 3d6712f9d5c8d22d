"""Where points lie in a picture."""

from __future__ import annotations

from torch import Tensor

from scene_experts.core.types import Camera


def project(xyz: Tensor, camera: Camera) -> tuple[Tensor, Tensor, Tensor]:
    """Return the columns and rows, in px from the upper left corner, and the depths of the points
    [n, 3] in a camera, each [n] and float64. A point at a depth of 0 or less is not in the picture,
    wherever its column and row are.

    The sums are written out: products of matrices are rounded differently from processor to
    processor.
    """
    pose, (x, y, z) = camera.world_to_cam.double(), xyz.double().unbind(1)
    right, down, depth = (x * pose[i, 0] + y * pose[i, 1] + z * pose[i, 2] + pose[i, 3] for i in range(3))
    return camera.fx * right / depth + camera.cx, camera.fy * down / depth + camera.cy, depth
