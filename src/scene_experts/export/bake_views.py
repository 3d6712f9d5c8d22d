"""The cameras that a bake looks from: the training views, and views between neighbouring ones. Held-out views are never among them."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from scene_experts.data.views import Capture
from scene_experts.errors import InputError
from scene_experts.geometry.rotation import matrix_to_quat, quat_to_matrix
from scene_experts.types import Camera
from scene_experts.view.paths import FREE, pose, slerp

NEIGHBOURS = 4  # training views that a view may be joined with
LEAST_VIEWS = 60  # sums over views are taken over at least so many, views between the training views among them
MOST_VIEWS = 240  # and over at most so many, evenly chosen


@dataclass(frozen=True)
class Views:
    """The training cameras of a capture and which of them are near each other."""

    cameras: tuple[Camera, ...]  # as no view of the capture, so that appearance codes are those of a free camera
    positions: Tensor  # [V, 3] float64
    quats: Tensor  # [V, 4] float64, camera to world
    near: Tensor  # [V, n] int64, the nearest others first

    @classmethod
    def of(cls, capture: Capture) -> Views:
        """Looks at the training views. Raises InputError where there is none."""
        if not capture.train:
            raise InputError("expected training views to bake from, found none in the capture; choose another --split")
        cameras = tuple(replace(capture.views[i].camera, id=FREE) for i in capture.train)
        poses = torch.stack([c.world_to_cam.double() for c in cameras])
        rotations = poses[:, :3, :3].transpose(1, 2)
        positions = -(rotations @ poses[:, :3, 3:]).squeeze(2)
        return cls(cameras, positions, matrix_to_quat(rotations), neighbours(positions, rotations[:, :, 2], capture.extent))

    def __len__(self) -> int:
        return len(self.cameras)

    def between(self, generator: torch.Generator) -> Camera:
        """A random view on the straight way from a training view to one of its neighbours, with the lens of the first."""
        first = int(torch.randint(len(self.cameras), (1,), generator=generator))
        if not self.near.shape[1]:
            return self.cameras[first]
        second = int(self.near[first, int(torch.randint(self.near.shape[1], (1,), generator=generator))])
        u = float(torch.rand(1, generator=generator))
        place = torch.lerp(self.positions[first], self.positions[second], u)
        rotation = quat_to_matrix(slerp(self.quats[first], self.quats[second], u))
        return replace(self.cameras[first], world_to_cam=pose(place, rotation).to(self.cameras[first].world_to_cam.dtype))

    def for_sums(self, generator: torch.Generator, least: int = LEAST_VIEWS, most: int = MOST_VIEWS) -> list[Camera]:
        """The cameras over which sums are taken: all training views or `most` of them, filled up to `least` with views between them."""
        chosen = torch.linspace(0, len(self) - 1, min(len(self), most)).round().long().tolist()
        return [self.cameras[i] for i in chosen] + [self.between(generator) for _ in range(least - len(chosen))]


def neighbours(positions: Tensor, forward: Tensor, extent: float, count: int = NEIGHBOURS) -> Tensor:
    """The `count` nearest other views [V, n] int64 (n smaller where there are fewer): distance in extents plus the turn between directions.

    positions, forward [V, 3] float64: camera centres and unit viewing directions.
    """
    turn = (1 - forward @ forward.T).clamp_min(0)
    away = torch.cdist(positions, positions) / max(extent, 1e-12) + turn
    away.fill_diagonal_(float("inf"))
    return away.argsort(dim=1)[:, : min(count, len(positions) - 1)]
