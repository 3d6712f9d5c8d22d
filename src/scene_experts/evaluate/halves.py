"""Appearance codes of held-out views, found on the left half of each photograph; only the right half is then scored.

The protocol of NeRF in the Wild (Martin-Brualla et al. 2021, section 4), for captures whose light changes from view to view: what a
photograph's exposure was can only be known from the photograph, and no pixel serves both purposes.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from scene_experts.core.errors import InputError
from scene_experts.core.types import Camera, Mode
from scene_experts.scene.anchors.appearance import Codes

if TYPE_CHECKING:
    from scene_experts.data.capture import Capture
    from scene_experts.render import Rasterizer
    from scene_experts.scene import Scene

STEPS, RATE = 60, 0.1  # of Adam, from the mean of all codes; the rate falls linearly to 0


def codes_of(scene: Scene) -> Codes:
    """The scene's appearance codes. Raises InputError where it has none."""
    codes = scene.codes
    if codes is None:
        raise InputError("expected a scene with appearance codes for --appearance half, found none; train with --scene.appearance 32")
    return codes


def left(height: int, width: int, device: torch.device | str = "cpu") -> Tensor:
    """[H, W], 1 on the left half (the middle column of an odd width is right)."""
    return (torch.arange(width, device=device) < width // 2).float().expand(height, width)


def right_mask(mask: Tensor | None, height: int, width: int) -> Tensor:
    """What is scored: the right half of what counts [H, W]."""
    half = 1.0 - left(height, width)
    return half if mask is None else half * mask


def fit(
    scene: Scene,
    capture: Capture,
    rasterize: Rasterizer,
    chosen: Sequence[int],
    step: int,
    background: Tensor,
    tell: Callable[[int, int], None] = lambda done, total: None,
) -> None:
    """Find the code of each of the views `chosen` and put it into the scene's codes; nothing else of the scene changes."""
    codes = codes_of(scene)
    for n, index in enumerate(chosen):
        camera, frame = capture.views[index].camera.to(background.device), capture.frame(index)
        counts = left(camera.height, camera.width) * (1.0 if frame.mask is None else frame.mask)
        photo = (frame.rgb.float() / 255).to(background.device)
        codes.fitted[camera.id] = fitted(scene, codes, rasterize, camera, photo, counts.to(background.device), step, background)
        tell(n + 1, len(chosen))


def fitted(
    scene: Scene, codes: Codes, rasterize: Rasterizer, camera: Camera, photo: Tensor, counts: Tensor, step: int, background: Tensor
) -> Tensor:
    """The code [dim] under which the counted pixels [H, W] of the photograph [H, W, 3] are met best in L1; the best one seen."""
    code = codes.table.detach().mean(dim=0).requires_grad_()
    optimizer = torch.optim.Adam([code])
    best, least = code.detach().clone(), float("inf")
    area = 3 * counts.sum().clamp_min(1e-12)
    for i in range(STEPS):
        codes.fitted[camera.id] = code
        image = rasterize(scene(camera, step, Mode.DRAW, rasterize.visible).gaussians, camera, background).image
        loss = ((image.clamp(0, 1) - photo).abs() * counts[..., None]).sum() / area
        if loss.item() < least:
            best, least = code.detach().clone(), loss.item()
        if not loss.requires_grad:
            break  # nothing is seen
        (code.grad,) = torch.autograd.grad(loss, [code])
        optimizer.param_groups[0]["lr"] = RATE * (1 - i / STEPS)
        optimizer.step()
    return best
