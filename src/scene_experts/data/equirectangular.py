"""Equirectangular pictures, 360 degrees around: perspective views of them.

A picture of W x H = 2:1 pixels shows the direction of longitude lon (to the right) and latitude lat
(up) at u = (lon / 2 pi + 1/2) W, v = (1/2 - lat / pi) H. The frame of a panorama has the axes of a
camera that looks at its middle: x right, y down, z forward.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

FIELD = 90.0  # degrees, of a view
SEAM, POLE, EDGE = 2.2, 0.6, 0.3
"""What a panorama without XMP data shows: its left and right edges differ at most this many times as
much as neighbouring columns do, its top and bottom rows vary at most this share of its middle, and
its edges vary at least this share of what its columns do: plain edges meet without being one."""


@dataclass(frozen=True)
class PanoramaView:
    """A perspective view of FIELD degrees out of a panorama, square."""

    yaw: int  # degrees to the right of the panorama's middle
    pitch: int  # degrees up

    @property
    def folder(self) -> str:
        """The folder of these views in a capture; COLMAP finds the views of a rig by it."""
        return f"yaw{self.yaw:03d}_pitch{self.pitch:+03d}"

    @property
    def rig_from_view(self) -> np.ndarray:
        """The rotation [3, 3] from the axes of the view to those of the panorama."""
        yaw, pitch = math.radians(self.yaw), math.radians(self.pitch)
        turn = np.array([[math.cos(yaw), 0, math.sin(yaw)], [0, 1, 0], [-math.sin(yaw), 0, math.cos(yaw)]])
        tilt = np.array([[1, 0, 0], [0, math.cos(pitch), -math.sin(pitch)], [0, math.sin(pitch), math.cos(pitch)]])
        return turn @ tilt


VIEWS = tuple(PanoramaView(yaw, pitch) for pitch, first in ((0, 45), (35, 0), (-35, 0)) for yaw in range(first, 360, 90))
"""Twelve views: all that lies within 75 degrees of the horizon is in one of them, most in two."""
FOLDERS = frozenset(view.folder for view in VIEWS)


def find_place(name: str) -> str:
    """Return the panorama that a photograph was cut from; of others, their own name."""
    folder, _, rest = name.partition("/")
    return rest if folder in FOLDERS else name


def view_side(width: int) -> int:
    """Return the side in pixels of a view whose middle has the resolution of a panorama of `width`
    pixels."""
    return max(2, 2 * round(width / math.pi * math.tan(math.radians(FIELD / 2)) / 2))


def find_places(view: PanoramaView, side: int, size: tuple[int, int]) -> Tensor:
    """Return where the pixels of a view lie in a panorama of `size` (width, height): [side, side,
    2] float32, in pixels from its top left corner."""
    focal = side / 2 / math.tan(math.radians(FIELD / 2))
    across = (torch.arange(side, dtype=torch.float64) + 0.5 - side / 2) / focal
    y, x = torch.meshgrid(across, across, indexing="ij")
    rays = torch.stack([x, y, torch.ones_like(x)], -1) @ torch.from_numpy(view.rig_from_view).T
    lon, lat = torch.atan2(rays[..., 0], rays[..., 2]), torch.asin(-rays[..., 1] / rays.norm(dim=-1))
    return torch.stack([(lon / (2 * math.pi) + 0.5) * size[0], (0.5 - lat / math.pi) * size[1]], -1).float()


def sample(picture: np.ndarray, places: Tensor, nearest: bool = False) -> np.ndarray:
    """Return the values of a panorama [H, W] or [H, W, C] uint8 at places [h, w, 2] by cubic
    interpolation, around its seam too."""
    values = torch.from_numpy(np.array(np.atleast_3d(picture))).permute(2, 0, 1)
    border = 2
    values = torch.cat([values[..., -border:], values, values[..., :border]], -1)
    height, width = values.shape[1:]
    scale = torch.tensor([2 / width, 2 / height])
    grid = ((places + torch.tensor([float(border), 0.0])) * scale - 1)[None]
    mode = "nearest" if nearest else "bicubic"
    planes = [functional.grid_sample(plane[None, None].float(), grid, mode, "border", align_corners=False)[0, 0] for plane in values]
    return torch.stack(planes, -1).round().clamp(0, 255).to(torch.uint8).numpy().reshape(*places.shape[:2], *picture.shape[2:])


def is_seamless(picture: np.ndarray) -> bool:
    """Return whether a picture [H, W, 3] of 2:1 goes on from its right edge at its left edge, and
    shows one direction in its top row and one in its bottom row, as panoramas do."""
    values = picture.astype(np.float32)
    seam = np.abs(values[:, 0] - values[:, -1]).mean()
    beside = np.abs(np.diff(values, axis=1)).mean()
    poles = max(values[row].std(axis=0).mean() for row in (0, -1))
    columns = values.std(axis=0).mean(1)
    plain = min(columns[0], columns[-1]) < EDGE * max(float(np.median(columns)), 4.0)
    return bool(not plain and seam <= SEAM * max(beside, 1.0) and poles <= POLE * max(values[len(values) // 2].std(axis=0).mean(), 4.0))


def mask_nadir(view: PanoramaView, side: int, nadir: float) -> np.ndarray:
    """Return a mask [side, side] uint8: 0 within `nadir` degrees of straight down, else 255."""
    height = 1800  # tenths of a degree
    latitude = 90 - find_places(view, side, (2 * height, height))[..., 1].numpy() / 10
    return np.where(latitude < nadir - 90, 0, 255).astype(np.uint8)
