"""Exposure and white balance of each training photograph, for captures whose camera changes them.

A photograph is the picture of the scene times a gain for each channel, in linear light: the
response is taken as x^(1 / GAMMA), so that a picture times 2^(s / GAMMA) is one that is s stops
brighter. Brighter than white is white. The gains of all training photographs have the mean 1 (their
logarithms have the mean 0), so the scene itself is that of the mean exposure: files and viewers need
nothing else. After PPISP (Deutsch et al., CVPR 2026), whose vignette and learned response are left
out here: on fox they changed nothing (results/exposure.md).

A camera that took no training photograph has the gains of those near it: the mean of their
logarithms with weights 1 / d^2, where d is the distance between the positions, over their mean
distance from their middle, plus that between the directions. That mean times a factor from 0 to 1:
the one with which the training photographs, each left out in turn, are told best. It is near 1
where the exposure changes from place to place, and 0 where it changes at random.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor, nn

from scene_experts.core.schedule import Rate
from scene_experts.core.types import Camera
from scene_experts.scene.per_view import PerView

GAMMA = 2.2
GROUP = "exposure"  # name of the learning rate, and of the tensors in a checkpoint
RATE = Rate(0.01, 0.0001)  # stops, from the start of the training to the end
SHORT, MOST = 3000, 5.0  # iterations; below, the rate is sqrt(SHORT / iterations) times as large, at most MOST times
RISE = 100  # iterations in which the rate rises linearly to it; a thirtieth of a short training
NEAREST = 1e-3  # of d: cameras nearer to a training camera have its gains


class Exposures(PerView):
    """Gains of the training photographs, by the ids of their cameras."""

    group, learned, buffers_kept = GROUP, "stops", ("ids", "positions", "directions")
    stops: nn.Parameter  # [V, 3] RGB
    positions: Tensor  # [V, 3] trained world
    directions: Tensor  # [V, 3] unit

    def __init__(self, cameras: Sequence[Camera]) -> None:
        super().__init__()
        self.stops = nn.Parameter(torch.zeros(len(cameras), 3))
        self.set_cameras(cameras)
        self.register_buffer("positions", torch.stack([camera.position.cpu().float() for camera in cameras]))
        self.register_buffer("directions", torch.stack([_direction(camera) for camera in cameras]))

    def continue_from(self, earlier: Exposures) -> None:
        """Take the stops of the photographs that an earlier training has seen."""
        with torch.no_grad():
            for id, row in self.row.items():
                if id in earlier.row:
                    self.stops[row] = earlier.stops[earlier.row[id]].to(self.stops)

    def stops_of(self, camera: Camera) -> Tensor:
        """Return the stops [3] of a camera, relative to the mean of the training photographs."""
        stops = self.stops - self.stops.mean(0)
        row = self.row.get(camera.id)
        if row is not None:
            return stops[row]
        weights = self._weigh(camera.position.to(self.positions)[None], _direction(camera).to(self.directions)[None])
        return self._trust(stops.detach()) * (weights @ stops)[0]

    def _weigh(self, positions: Tensor, directions: Tensor) -> Tensor:
        """Weights [n, V] of the photographs for cameras; the sum of each row is 1."""
        spread = (self.positions - self.positions.mean(0)).norm(dim=1).mean().clamp_min(1e-12)
        away = torch.cdist(positions, self.positions) / spread + torch.cdist(directions, self.directions)
        weights = away.clamp_min(NEAREST).pow(-2)
        return weights / weights.sum(1, keepdim=True)

    def _trust(self, stops: Tensor) -> float:
        """How far the photographs near one tell its stops [V, 3]: the factor from 0 to 1."""
        if len(stops) < 3:
            return 1.0
        weights = self._weigh(self.positions, self.directions).fill_diagonal_(0)
        told = (weights / weights.sum(1, keepdim=True).clamp_min(1e-12)) @ stops
        return float(((told * stops).sum() / told.square().sum().clamp_min(1e-12)).clamp(0, 1))

    def expose(self, image: Tensor, camera: Camera) -> Tensor:
        """Return the picture [H, W, 3] of the scene as a camera photographs it, at most 1."""
        return _Bounded.apply(image * torch.exp2(self.stops_of(camera) / GAMMA).to(image))

    def expose_directly(self, image: Tensor, camera: Camera) -> tuple[Tensor, Callable[[Tensor], Tensor]]:
        """Return `expose` without a graph, and the function that takes the gradient of the loss in
        it, adds to that of the stops, and returns that in `image`."""
        with torch.enable_grad():
            leaf = image.detach().requires_grad_()
            exposed = self.expose(leaf, camera)

        def go_back(gradient: Tensor) -> Tensor:
            exposed.backward(gradient)
            assert leaf.grad is not None
            return leaf.grad

        return exposed.detach(), go_back

    @torch.no_grad()
    def undo(self, photograph: Tensor, camera: Camera) -> Tensor:
        """Return a photograph [H, W, 3] as it would be at the mean exposure."""
        return photograph / torch.exp2(self.stops_of(camera) / GAMMA).to(photograph)

    def learning_rate(self, step: int, total: int) -> float:
        """Return the learning rate at `step` of `total`."""
        faster = min(MOST, max(1.0, SHORT / total) ** 0.5)
        return RATE.at(step, total) * faster * min(1.0, step / min(RISE, max(1.0, total / 30)))


class _Bounded(torch.autograd.Function):
    """min(x, 1). Where x is above 1, only gradients that lower it pass."""

    @staticmethod
    def forward(ctx: Any, x: Tensor) -> Tensor:  # type: ignore[override]
        ctx.save_for_backward(x)
        return x.clamp(max=1.0)

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> Tensor:  # type: ignore[override]
        (x,) = ctx.saved_tensors
        return torch.where((x > 1) & (gradient < 0), 0.0, gradient)


def _direction(camera: Camera) -> Tensor:
    return camera.world_to_cam[2, :3].cpu().float()
