"""The values that modules exchange, and the definitions of shapes, frames and units.

Dimensions
    N rows of a table (anchors or Gaussians)   K slots per row (Gaussians per anchor)
    A rows seen by a camera                    M Gaussians handed to the rasteriser
    F feature size   E experts   k experts chosen per anchor   H, W pixels

Frames and units
    World: the capture's frame after `data.prepare` (scaled and shifted; `Capture.world` undoes it).
    Lengths are in world units. Camera: OpenCV axes (x right, y down, z forward); `world_to_cam`
    maps homogeneous world points to camera points. Pixels: pixel (column i, row j) has its centre
    at (i + 0.5, j + 0.5). `K` uses this convention, as in COLMAP. Images: float RGB in [0, 1], [H,
    W, 3].  Quaternions: (w, x, y, z). 2D gradients: d loss / d (mean in NDC), which is the pixel
    gradient times (W/2, H/2), in all backends.
"""

from __future__ import annotations

import enum
import functools
import math
from collections.abc import Mapping
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from scene_experts.core.transfer import upload


class Mode(enum.Enum):
    """The use of a scene. Only this value controls randomness and adaptive state in a scene.

    `nn.Module.train()`, `nn.Module.eval()` and the gradient mode have no effect on them.
    """

    TRAIN = "train"
    """Routers add noise, router biases are updated, and coarse-to-fine training uses only the
    levels reached so far."""
    DRAW = "draw"
    """Deterministic and without changes of state: for rendering, evaluation and measurements, with
    or without gradients."""


@dataclass(frozen=True)
class Camera:
    """A pinhole camera with a free principal point."""

    world_to_cam: Tensor  # [4, 4] float32
    K: Tensor  # [3, 3] float32, px: [[fx, 0, cx], [0, fy, cy], [0, 0, 1]]
    width: int
    height: int
    near: float = 0.2  # world units; Gaussians closer than this along z are not rendered
    id: int = 0  # index of the view in its capture

    @functools.cached_property
    def position(self) -> Tensor:
        """Camera centre in world coordinates, [3]."""
        R, t = self.world_to_cam[:3, :3], self.world_to_cam[:3, 3]
        return -(R.transpose(0, 1) @ t)

    @functools.cached_property
    def pinhole(self) -> tuple[float, float, float, float]:
        """fx, fy, cx, cy, px. They are cached before a copy to a device, because reading them from
        a device would synchronise with it."""
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
        """Vertical field of view, radians, if the principal point is at the image centre."""
        return 2.0 * math.atan(self.height / (2.0 * self.fy))

    def shrunk(self, by: int) -> Camera:
        """Return the camera of a picture of 1 / by of the size, rounded down: each of its pixels shows
        what by x by pixels of this one show. It is made once."""
        if by == 1:
            return self
        known: dict[int, Camera] = self.__dict__.setdefault("shrunken", {})
        if by not in known:
            K = self.K.clone()
            K[:2] /= by
            known[by] = replace(self, K=K, width=self.width // by, height=self.height // by)
        return known[by]

    def to(self, device: torch.device | str | None = None, dtype: torch.dtype | None = None) -> Camera:
        """Return the camera with its tensors on `device` and with `dtype`. One on a GPU is made
        once."""
        known = self.__dict__.setdefault("moved", {}) if device is not None and torch.device(device).type == "cuda" else {}
        if (device, dtype) not in known:
            known[device, dtype] = self._move(device, dtype)
        return known[device, dtype]

    def _move(self, device: torch.device | str | None, dtype: torch.dtype | None) -> Camera:
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
    """Input of a rasteriser: M Gaussians with fixed colours."""

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
    """A rendered image and the values that densification needs.

    `mean2d_grad` is a tensor of zeros that the backward pass of the image fills: with d loss / d
    mean2d, or, from a rasteriser with `absolute`, with the sums over the pixels of |d loss / d
    mean2d| through each pixel alone (AbsGS), for each axis.
    """

    image: Tensor  # [H, W, 3], blended with the background, not clamped
    alpha: Tensor  # [H, W] = 1 - final transmittance
    depth: Tensor  # [H, W] expected depth: sum_i T_i alpha_i z_i (not divided by alpha)
    radii: Tensor  # [M] int32 px, ceil(3 sigma), as in the published rasteriser; 0 if the Gaussian was not rendered
    mean2d_grad: Tensor  # [M, 2] NDC units


@dataclass(frozen=True)
class Routing:
    """Assignment of the anchors of one view to the experts of one attribute."""

    gates: Tensor  # [A, E], rows sum to 1 (paper eq. 3)
    chosen: Tensor | None  # [A, k] int64, None while dense


@dataclass(frozen=True)
class Decoded:
    """The decoded scene of one camera, before rasterisation."""

    gaussians: Gaussians
    rows: Tensor  # [A] int64, rows of the table that were decoded
    raw_opacity: Tensor | None  # [A, K] before masking; None for explicit scenes
    routing: Mapping[str, Routing]  # by attribute; empty without experts
    population: tuple[Tensor, Tensor] | None = None  # explicit scenes: opacity logits [N], log-scales [N, 3] of all Gaussians
