"""Surveys: what training views show of a scene's Gaussians, beyond the view of the current
iteration.

The contribution of a Gaussian to a picture is the sum over pixels of its blending weight T alpha,
in pixels. It is the derivative of the picture's sum with respect to the Gaussian's colour. One
backward pass gives three such sums, with another weight of the pixels in each channel.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Protocol

import torch
from torch import Tensor

from scene_experts.core.types import Camera, Decoded, Gaussians, Mode, Render
from scene_experts.scene import Scene


class Draw(Protocol):
    """The part of a rasteriser that a survey uses."""

    def __call__(self, g: Gaussians, camera: Camera, background: Tensor) -> Render: ...
    def visible(self, means: Tensor, scales: Tensor, camera: Camera) -> Tensor: ...


@dataclass(frozen=True)
class TrainingPhoto:
    """A training view."""

    camera: Camera
    image: Tensor  # [H, W, 3], the photograph
    mask: Tensor | None = None  # [H, W]; pixels with 0 are ignored


@dataclass(frozen=True)
class Survey:
    """The training views and the means to draw them."""

    views: Sequence[int]
    photo: Callable[[int], TrainingPhoto]
    draw: Draw
    background: Tensor  # [3]

    def sample(self, count: int, generator: torch.Generator) -> list[int]:
        """Return `count` different views (0 or more than there are: all) in random order."""
        order = torch.randperm(len(self.views), generator=generator).tolist()
        return [self.views[i] for i in order[: count or len(order)]]

    @torch.no_grad()
    def see(self, scene: Scene, view: int, step: int, weigh: Callable[[Tensor, TrainingPhoto], Tensor]) -> tuple[Decoded, Tensor]:
        """Draw a view. Returns the decoded scene and the sums [M, 3] over pixels of T alpha times
        `weigh(image, photo)` [H, W, 3]."""
        photo = self.photo(view)
        decoded = scene(photo.camera, step, Mode.DRAW, self.draw.visible)
        colors = decoded.gaussians.colors.detach().clone().requires_grad_()
        with torch.enable_grad():
            image = self.draw(replace(decoded.gaussians, colors=colors), photo.camera, self.background.to(colors)).image
        (sums,) = torch.autograd.grad(image, colors, weigh(image.detach(), photo))
        return decoded, sums.clamp_min_(0)


def weigh_all(image: Tensor, photo: TrainingPhoto) -> Tensor:
    """Weights of 1, so that all three sums are the contribution."""
    return torch.ones_like(image)


def weigh_errors(image: Tensor, photo: TrainingPhoto, quantile: float) -> Tensor:
    """Weights [H, W, 3]: 1, then 1 at pixels whose error is above the quantile of the picture, then
    the error.

    The error of a pixel is the mean over the channels of |image - photograph|. The weights of
    masked pixels are 0.
    """
    error = (image.clamp(0, 1) - photo.image).abs().mean(2)
    known = torch.ones_like(error) if photo.mask is None else (photo.mask > 0).to(error)
    values = error[known > 0]
    place = max(1, min(values.numel(), round(quantile * values.numel())))
    limit = values.kthvalue(place).values if values.numel() else error.new_zeros(())
    return torch.stack([known, (error > limit).to(error) * known, error * known], dim=2)
