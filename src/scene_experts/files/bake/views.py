"""The cameras of a bake: the training views, and free views between and around neighbouring
training views.

Held-out views are never used. Free views are needed: where the scene leaves out a Gaussian that
training views show (its anchor is behind the camera, its opacity is negative), a baked Gaussian
would appear as fog, and training views alone do not reveal it.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from scene_experts.core.errors import InputError
from scene_experts.core.types import Camera
from scene_experts.data.views import Capture
from scene_experts.geometry.poses import FREE, make_pose, slerp
from scene_experts.geometry.rotation import matrix_to_quat, quat_to_matrix

NEIGHBOURS = 8  # training views that a view may be joined with
BEYOND = 0.1  # the corners of the triangle of three neighbours move outwards by this share
LEAST_VIEWS = 60  # views of the sums, at least
MOST_TRAINING = 120  # training views among them, at most, evenly chosen
FREE_SHARE = 0.25  # free views among them per training view, at least


@dataclass(frozen=True)
class Views:
    """The training cameras of a capture and the nearest neighbours of each."""

    cameras: tuple[Camera, ...]  # with the id of a free camera, which chooses its appearance code
    positions: Tensor  # [V, 3] float64
    quats: Tensor  # [V, 4] float64, camera to world
    near: Tensor  # [V, n] int64, the nearest first

    @classmethod
    def of(cls, capture: Capture) -> Views:
        """The training views of a capture. Raises InputError without any."""
        if not capture.train:
            raise InputError("expected training views to bake from, found none in the capture; choose another --split")
        cameras = tuple(replace(capture.views[i].camera, id=FREE) for i in capture.train)
        poses = torch.stack([c.world_to_cam.double() for c in cameras])
        rotations = poses[:, :3, :3].transpose(1, 2)
        positions = -(rotations @ poses[:, :3, 3:]).squeeze(2)
        return cls(cameras, positions, matrix_to_quat(rotations), neighbours(positions, rotations[:, :, 2], capture.extent))

    def __len__(self) -> int:
        return len(self.cameras)

    def free(self, generator: torch.Generator) -> Camera:
        """A random view in the triangle of a training view and two of its neighbours: rotation
        between theirs, lens of the first."""
        i, (j, k) = self._three(generator)
        share = -torch.rand(3, generator=generator, dtype=torch.float64).clamp_min(1e-12).log()
        share = share / share.sum() * (1 + 3 * BEYOND) - BEYOND  # uniform in the enlarged triangle
        place = share @ self.positions[[i, j, k]]
        turned = slerp(self.quats[i], self.quats[j], _part(share[1], share[0]))
        turned = slerp(turned, self.quats[k], _part(share[2], share[0] + share[1]))
        first = self.cameras[i]
        return replace(first, world_to_cam=make_pose(place, quat_to_matrix(turned)).to(first.world_to_cam.dtype))

    def _three(self, generator: torch.Generator) -> tuple[int, list[int]]:
        """A training view and two of its neighbours; the view itself takes the place of missing
        ones."""
        first = int(torch.randint(len(self.cameras), (1,), generator=generator))
        near = self.near[first]
        others = near[torch.randperm(len(near), generator=generator)[:2]].tolist()
        return first, (others + [first, first])[:2]

    def for_sums(self, generator: torch.Generator) -> list[Camera]:
        """The cameras of the sums: training views, all or evenly chosen, and free views."""
        n = min(len(self), MOST_TRAINING)
        chosen = torch.linspace(0, len(self) - 1, n).round().long().tolist()
        free = max(LEAST_VIEWS - n, round(FREE_SHARE * n))
        return [self.cameras[i] for i in chosen] + [self.free(generator) for _ in range(free)]


def neighbours(positions: Tensor, forward: Tensor, extent: float, count: int = NEIGHBOURS) -> Tensor:
    """The `count` nearest other views [V, n] int64 (n = all others where there are fewer), by
    distance in extents plus change of direction.

    positions, forward [V, 3] float64: camera centres and unit viewing directions.
    """
    turn = (1 - forward @ forward.T).clamp_min(0)
    away = torch.cdist(positions, positions) / max(extent, 1e-12) + turn
    away.fill_diagonal_(float("inf"))
    return away.argsort(dim=1)[:, : min(count, len(positions) - 1)]


def _part(one: Tensor, other: Tensor) -> float:
    """The first of two shares relative to their sum, in [0, 1]."""
    one, other = one.clamp_min(0), other.clamp_min(0)
    return float(one / (one + other).clamp_min(1e-12))
