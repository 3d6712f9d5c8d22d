"""What a capture is, once loaded: views, points, split, and the world it is trained in."""

from __future__ import annotations

import hashlib
import json
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Literal

import torch
from torch import Tensor

from scene_experts.core.types import Camera, Points
from scene_experts.data.store import ImageStore

Kind = Literal["colmap", "blender", "nerfstudio"]


@dataclass(frozen=True)
class View:
    """One photograph: its name in the capture, its camera in the trained world at the trained resolution, and its file."""

    name: str  # relative, with extension, unique
    camera: Camera
    path: Path


@dataclass(frozen=True)
class Frame:
    """The pixels of a view."""

    rgb: Tensor  # [H, W, 3] uint8
    mask: Tensor | None  # [H, W] float32 in [0, 1], 1 = counts; None: all count


@dataclass(frozen=True)
class World:
    """The frame a capture is trained in: trained = (input + shift) * scale, lengths by `scale`, axes kept."""

    scale: float = 1.0
    shift: tuple[float, float, float] = (0.0, 0.0, 0.0)

    @property
    def identity(self) -> bool:
        return self.scale == 1.0 and self.shift == (0.0, 0.0, 0.0)

    def from_input(self, xyz: Tensor) -> Tensor:
        """Input points [..., 3] in the trained world."""
        return (xyz + torch.tensor(self.shift, dtype=xyz.dtype, device=xyz.device)) * self.scale

    def to_input(self, xyz: Tensor) -> Tensor:
        """Trained points [..., 3] in the capture's own frame and unit."""
        return xyz / self.scale - torch.tensor(self.shift, dtype=xyz.dtype, device=xyz.device)

    def camera_from_input(self, camera: Camera) -> Camera:
        """The same view in the trained world; the near plane is a length and is scaled too."""
        pose = camera.world_to_cam.double()
        shift = torch.tensor(self.shift, dtype=torch.float64, device=pose.device)
        t = (pose[:3, 3] - pose[:3, :3] @ shift) * self.scale  # x_cam = R (X / scale - shift) + t, and lengths times scale
        return _moved(camera, t, self.scale)

    def camera_to_input(self, camera: Camera) -> Camera:
        """The inverse of `camera_from_input`."""
        pose = camera.world_to_cam.double()
        shift = torch.tensor(self.shift, dtype=torch.float64, device=pose.device)
        return _moved(camera, pose[:3, 3] / self.scale + pose[:3, :3] @ shift, 1 / self.scale)

    def then(self, shift: tuple[float, float, float], scale: float) -> World:
        """This world followed by another: (trained + shift) * scale."""
        x, y, z = (a + b / self.scale for a, b in zip(self.shift, shift))
        return World(self.scale * scale, (x, y, z))


def _moved(camera: Camera, t: Tensor, scale: float) -> Camera:
    pose = camera.world_to_cam.double().clone()
    pose[:3, 3] = t
    return replace(camera, world_to_cam=pose.to(camera.world_to_cam.dtype), near=camera.near * scale)


@dataclass(frozen=True)
class Capture:
    """Posed photographs ready to train on, with what was decided on the way so that results can state it."""

    name: str
    root: Path
    kind: Kind
    views: tuple[View, ...]  # sorted by name; view i has camera.id == i
    points: Points | None
    train: tuple[int, ...]
    test: tuple[int, ...]
    images: ImageStore  # frame i belongs to view i
    world: World
    extent: float  # R = 1.1 x the largest distance of a training camera from their mean (3DGS), in trained units
    resolution: str  # "as-is", "cap1600", "factor:2", "longest:800", "inria:4"
    split: str  # "mod8", "first:31", "none", "files"
    background: tuple[float, float, float]  # what the scene is rendered over
    warnings: tuple[str, ...] = field(default=())

    def frame(self, index: int) -> Frame:
        """The pixels of view `index`. Raises InputError where the file cannot be read."""
        rgb, mask = self.images.get(index)
        return Frame(rgb, None if mask is None else mask.float() / 255)

    def fingerprint(self) -> str:
        """A short hash of the views' names and sizes and of the split, by which a run knows its capture again wherever it lies."""
        seen = [[(v.name, v.camera.width, v.camera.height) for v in self.views], self.train, self.test]
        return hashlib.sha256(json.dumps(seen).encode()).hexdigest()[:16]
