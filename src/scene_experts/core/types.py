"""The values that flow between the parts, and the one key to shapes, frames and units.

Dimensions
    N rows of a table (anchors or Gaussians)   K slots per row (Gaussians per anchor)
    A rows seen by a camera                    M Gaussians handed to the rasteriser
    F feature size   E experts   k experts chosen per anchor   H, W pixels

Frames and units
    World: the capture's frame after `data.prepare` (scaled and shifted; `Capture.world` undoes it). Lengths are in world units.
    Camera: OpenCV axes (x right, y down, z forward); `world_to_cam` maps homogeneous world points to camera points.
    Pixels: pixel (column i, row j) has its centre at (i + 0.5, j + 0.5); `K` is in that convention, as COLMAP's is.
    Images: float RGB in [0, 1], [H, W, 3].  Quaternions: (w, x, y, z).
    2D gradients: d loss / d (mean in NDC), i.e. the pixel gradient times (W/2, H/2), in every backend.
"""

from __future__ import annotations

import enum
import functools
import math
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from scene_experts.core.transfer import upload


class Mode(enum.Enum):
    """What a scene is used for. Everything in a scene that is random or adapts obeys this value, and nothing else.

    `nn.Module.train()` and `eval()` have no effect on a scene, and neither has whether gradients are enabled.
    """

    TRAIN = "train"
    """Routers draw noise, biases of the router move, and a coarse-to-fine training uses the levels that it has reached."""
    DRAW = "draw"
    """Nothing is random and nothing changes: for pictures, evaluation and measurements, with or without gradients."""


@dataclass(frozen=True)
class Camera:
    """A pinhole camera with a free principal point."""

    world_to_cam: Tensor  # [4, 4] float32
    K: Tensor  # [3, 3] float32, px: [[fx, 0, cx], [0, fy, cy], [0, 0, 1]]
    width: int
    height: int
    near: float = 0.2  # world units; nothing closer than this along z is drawn
    id: int = 0  # index of the view in its capture

    @property
    def position(self) -> Tensor:
        """Camera centre in the world, [3]."""
        R, t = self.world_to_cam[:3, :3], self.world_to_cam[:3, 3]
        return -(R.transpose(0, 1) @ t)

    @functools.cached_property
    def pinhole(self) -> tuple[float, float, float, float]:
        """fx, fy, cx, cy, px. Read once, before the camera goes to a device: reading from there waits for all that the device has to do."""
        (fx, _, cx), (_, fy, cy), _ = self.K.tolist()
        return fx, fy, cx, cy

    @property
    def fx(self) -> float:
        return self.pinhole[0]

    @property
    def fy(self) -> float:
        return self.pinhole[1]

    @property
    def cx(self) -> float:
        return self.pinhole[2]

    @property
    def cy(self) -> float:
        return self.pinhole[3]

    @property
    def fov(self) -> float:
        """Vertical field of view of a camera with its principal point in the middle, radians."""
        return 2.0 * math.atan(self.height / (2.0 * self.fy))

    def to(self, device: torch.device | str | None = None, dtype: torch.dtype | None = None) -> Camera:
        """The same camera with its tensors on `device` and of `dtype`."""
        K = self.K.to(dtype=dtype)
        known = self.pinhole if K.dtype == self.K.dtype else replace(self, K=K).pinhole
        moved = replace(self, world_to_cam=upload(self.world_to_cam, device, dtype), K=upload(K, device))
        moved.__dict__["pinhole"] = known
        return moved


@dataclass(frozen=True)
class Points:
    """A coloured point cloud (structure from motion, or random)."""

    xyz: Tensor  # [P, 3] float64 world; float64 so that the lattice of the anchors is exact
    rgb: Tensor  # [P, 3] uint8


@dataclass(frozen=True)
class Gaussians:
    """What a rasteriser draws: M Gaussians with fixed colours."""

    means: Tensor  # [M, 3] world
    quats: Tensor  # [M, 4] (w, x, y, z), unit length
    scales: Tensor  # [M, 3] world, > 0: standard deviations along the rotated axes
    opacities: Tensor  # [M] in (0, 1]
    colors: Tensor  # [M, 3] >= 0
    source: Tensor  # [M] int64, row * K + slot in the scene's table

    def __len__(self) -> int:
        return self.means.shape[0]


@dataclass(frozen=True)
class Render:
    """A picture and what the strategies need to know about how it was made.

    `mean2d_grad` is a plain tensor of zeros that the backward pass of the picture fills in.
    """

    image: Tensor  # [H, W, 3], the background blended in, not clamped
    alpha: Tensor  # [H, W] = 1 - final transmittance
    depth: Tensor  # [H, W] expected depth: sum_i T_i alpha_i z_i (not divided by alpha)
    radii: Tensor  # [M] int32 px, ceil(3 sigma), as the published rasteriser has it; 0 where nothing was drawn
    mean2d_grad: Tensor  # [M, 2] NDC units


@dataclass(frozen=True)
class Routing:
    """How the anchors of one view were shared among the experts of one attribute."""

    gates: Tensor  # [A, E], rows sum to 1 (paper eq. 3)
    chosen: Tensor | None  # [A, k] int64, None while dense


@dataclass(frozen=True)
class Decoded:
    """A scene seen by one camera, before rasterising."""

    gaussians: Gaussians
    rows: Tensor  # [A] int64, rows of the table that were decoded
    raw_opacity: Tensor | None  # [A, K] before masking; None for explicit scenes
    routing: dict[str, Routing]  # by attribute; empty without experts
    scene_opacity: Tensor | None = None  # [N, K] of every anchor, seen or not; only where the objective asks for it
    population: tuple[Tensor, Tensor] | None = None  # explicit scenes: opacity logits [N], log-scales [N, 3] of every Gaussian, seen or not
