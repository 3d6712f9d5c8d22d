"""The training photographs of a capture, reduced for the plane sweep."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image
from torch import Tensor

from scene_experts.core.types import Camera
from scene_experts.data.views import Capture

LEAST = 16  # px of the shorter side that are left; the windows of the sweep have 7
UNCOUNTED = -1000.0  # grey level of a pixel that a mask leaves out
_AHEAD = 4  # photographs that are decoded ahead
_GREY = np.array([0.299, 0.587, 0.114], dtype=np.float32)  # luma of ITU-R BT.601


@dataclass(frozen=True)
class SmallPictures:
    """V pictures with P pixels in all, one after another, row by row."""

    grey: Tensor  # [P] float32, 0 to 255; UNCOUNTED where a pixel does not count
    rgb: Tensor  # [P, 3] uint8
    start: Tensor  # [V + 1] int64, first pixel of each view
    size: Tensor  # [V, 2] int32, width and height, px
    cameras: Tensor  # [V, 16] float64: rows of [R | t], world to camera; fx, fy, cx, cy, px

    def __len__(self) -> int:
        return len(self.size)

    @property
    def centres(self) -> NDArray[np.float64]:
        """Centres of the cameras [V, 3], in trained world units."""
        R, t = self.rotations
        return -np.einsum("vji,vj->vi", R, t)

    @property
    def rotations(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """R [V, 3, 3] and t [V, 3] of all cameras, world to camera."""
        pose = self.cameras.numpy()[:, :12].reshape(-1, 3, 4)
        return pose[:, :, :3], pose[:, :, 3]

    def project(self, view: int, xyz: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
        """Return the points [n, 3] in camera coordinates of a view [n, 3], and whether its picture
        shows them [n]."""
        c, (width, height) = self.cameras[view].numpy(), self.size[view].tolist()
        pose = c[:12].reshape(3, 4)
        local = _rotate(xyz, pose[:, :3]) + pose[:, 3]
        z = np.where(local[:, 2] > 0, local[:, 2], np.inf)
        u, v = c[12] * local[:, 0] / z + c[14], c[13] * local[:, 1] / z + c[15]
        return local, (local[:, 2] > 0) & (u >= 0) & (v >= 0) & (u < width) & (v < height)

    def find_pixels(self, view: int, xyz: NDArray[np.float64]) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
        """Return the pixels [m] of a view that show m of the points [n, 3], and their depths [m]."""
        local, inside = self.project(view, xyz)
        c, local = self.cameras[view].numpy(), local[inside]
        u, v = c[12] * local[:, 0] / local[:, 2] + c[14], c[13] * local[:, 1] / local[:, 2] + c[15]
        return v.astype(np.int64) * int(self.size[view, 0]) + u.astype(np.int64), local[:, 2]

    def unproject(self, view: int, pixels: NDArray[np.int64], depth: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the world points [n, 3] that the centres of a view's `pixels` [n] show at `depth`
        [n]. Pixels are counted from the view's first."""
        c, width = self.cameras[view].numpy(), int(self.size[view, 0])
        pose = c[:12].reshape(3, 4)
        x, y = (pixels % width + 0.5 - c[14]) / c[12] * depth, (pixels // width + 0.5 - c[15]) / c[13] * depth
        return _rotate(np.stack((x, y, depth), 1) - pose[:, 3], pose[:, :3].T)


def _rotate(xyz: NDArray[np.float64], R: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return R x for each x of xyz [n, 3]. Sums have one order, unlike those of a BLAS."""
    return xyz[:, :1] * R[:, 0] + xyz[:, 1:2] * R[:, 1] + xyz[:, 2:] * R[:, 2]


def reduce_pictures(capture: Capture, side: int) -> SmallPictures:
    """Reduce the training photographs, undistorted as they are trained on, until their longer side
    is `side` px; smaller ones stay as they are. Held-out photographs are not read.

    A reduced pixel is the mean of its area, and counts if all of its area does. Raises InputError
    if a file cannot be read.
    """
    grey, rgb, cameras, sizes = [], [], [], []
    for place, index in enumerate(capture.train):
        capture.images.prefetch(capture.train[place + 1 : place + 1 + _AHEAD])
        frame, camera = capture.frame(index), capture.views[index].camera
        size = _reduced_size(camera, side)
        pixels = np.asarray(Image.fromarray(frame.rgb.numpy()).resize(size, Image.Resampling.BOX)).reshape(-1, 3)
        level = (pixels.astype(np.float32) * _GREY).sum(1)
        if frame.mask is not None:
            mask = Image.fromarray((frame.mask.numpy() * 255).round().astype(np.uint8))
            level[np.asarray(mask.resize(size, Image.Resampling.BOX)).reshape(-1) < 255] = UNCOUNTED
        grey.append(level)
        rgb.append(pixels)
        cameras.append(_numbers(camera, size))
        sizes.append(size)
    start = np.concatenate(([0], np.cumsum([len(part) for part in grey])))
    return SmallPictures(
        torch.from_numpy(np.concatenate(grey)),
        torch.from_numpy(np.concatenate(rgb)),
        torch.from_numpy(start),
        torch.tensor(sizes, dtype=torch.int32),
        torch.tensor(cameras, dtype=torch.float64),
    )


def _reduced_size(camera: Camera, side: int) -> tuple[int, int]:
    scale = min(1.0, max(side / max(camera.width, camera.height), LEAST / min(camera.width, camera.height)))
    return max(1, round(camera.width * scale)), max(1, round(camera.height * scale))


def _numbers(camera: Camera, size: tuple[int, int]) -> list[float]:
    pose = camera.world_to_cam[:3].double().flatten().tolist()
    x, y = size[0] / camera.width, size[1] / camera.height
    return [*pose, camera.fx * x, camera.fy * y, camera.cx * x, camera.cy * y]
