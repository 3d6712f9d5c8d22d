"""Fits the appearance codes of held-out views to the left half of each photograph. Only the right
half is then scored.

This is the protocol of NeRF in the Wild (Martin-Brualla et al. 2021, section 4) for captures whose
light changes between views: the exposure of a photograph is known only from the photograph, and no
pixel is used both to fit and to score.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
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

STEPS, RATE = 60, 0.1  # steps and learning rate of Adam; the rate decreases linearly to 0


def require_codes(scene: Scene) -> Codes:
    """Return the appearance codes of a scene. Raises InputError if it has none."""
    codes = scene.codes
    if codes is None:
        raise InputError("expected a scene with appearance codes for --appearance half, found none; train with --scene.appearance 32")
    return codes


def left_half(height: int, width: int, device: torch.device | str = "cpu") -> Tensor:
    """Return a mask [H, W] that is 1 on the left half. The middle column of an odd width belongs to
    the right half."""
    return (torch.arange(width, device=device) < width // 2).float().expand(height, width)


def right_half(mask: Tensor | None, height: int, width: int) -> Tensor:
    """Return the right half of `mask` [H, W] (None: every pixel counts), the pixels that are
    scored."""
    half = 1.0 - left_half(height, width)
    return half if mask is None else half * mask


@contextmanager
def fitted_codes(
    scene: Scene,
    capture: Capture,
    rasterize: Rasterizer,
    chosen: Sequence[int],
    step: int,
    background: Tensor,
    tell: Callable[[int, int], None] = lambda done, total: None,
) -> Iterator[None]:
    """Fit the code of each of the views `chosen`; context manager in which the scene draws them
    with it. Nothing of it stays in the scene.

    tell: Called with the number of views that are done and the number of views.
    """
    codes = require_codes(scene)
    before = dict(codes.fitted)
    try:
        for n, index in enumerate(chosen):
            camera, frame = capture.views[index].camera.to(background.device), capture.frame(index)
            counts = left_half(camera.height, camera.width) * (1.0 if frame.mask is None else frame.mask)
            photo = (frame.rgb.float() / 255).to(background.device)
            codes.fitted[camera.id] = fit_code(scene, codes, rasterize, camera, photo, counts.to(background.device), step, background)
            tell(n + 1, len(chosen))
        yield
    finally:
        codes.fitted = before


def fit_code(
    scene: Scene, codes: Codes, rasterize: Rasterizer, camera: Camera, photo: Tensor, counts: Tensor, step: int, background: Tensor
) -> Tensor:
    """Return the code [dim] with the least L1 error over the counted pixels, starting from the mean
    of all codes.

    Args:
        photo: Photograph [H, W, 3] in [0, 1].
        counts: Weights [H, W] in [0, 1] of the pixels.
    """
    code = codes.table.detach().mean(dim=0).requires_grad_()
    optimizer = torch.optim.Adam([code])
    best, least = code.detach().clone(), float("inf")
    area = 3 * counts.sum().clamp_min(1e-12)
    for i in range(STEPS):
        codes.fitted[camera.id] = code
        image = rasterize(scene(camera, step, Mode.DRAW, rasterize.visible).gaussians, camera, background).image
        image = scene.as_photographed(image, camera)  # as it is scored
        loss = ((image.clamp(0, 1) - photo).abs() * counts[..., None]).sum() / area
        if loss.item() < least:
            best, least = code.detach().clone(), loss.item()
        if not loss.requires_grad:
            break  # nothing is visible
        (code.grad,) = torch.autograd.grad(loss, [code])
        optimizer.param_groups[0]["lr"] = RATE * (1 - i / STEPS)
        optimizer.step()
    return best
