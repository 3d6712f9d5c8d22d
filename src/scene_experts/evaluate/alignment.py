"""Held-out cameras of a run with refined poses, aligned with the scene, which does not change.

The scene of such a run belongs to its refined cameras, and nobody has refined the held-out ones.
Each is moved, from the pose of the capture, to where its photograph fits the scene best: STEPS
steps of Adam on the six numbers of its pose alone, by the L1 error. The score of a held-out view is
then that of its picture at this pose, which has seen its photograph. Compare it only with scores
that were aligned too (`eval --align-poses` for a run without refined poses).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import torch
from torch import Tensor

from scene_experts.core.types import Camera, Mode
from scene_experts.geometry.poses import exp_motion
from scene_experts.render import Rasterizer
from scene_experts.scene import Draws
from scene_experts.scene.poses import at_pose, attach

STEPS, RATE = 80, 1e-3  # steps and learning rate of Adam (rad and extents); the rate falls linearly to 0
ALIGNED_SHORT = "cameras fitted to these photographs"
ALIGNED = f"held-out cameras aligned with the frozen scene by their photographs, {STEPS} steps of Adam"


def align(
    draws: Draws,
    rasterize: Rasterizer,
    camera: Camera,
    photo: Tensor,
    counts: Tensor | None,
    step: int,
    background: Tensor,
    extent: float,
    expose: Callable[[Tensor, Camera], Tensor] = lambda image, camera: image,
) -> Camera:
    """Return the camera at the pose with the least L1 error that is found near its own.

    Args:
        draws: The scene; `step` is its iteration.
        photo: Photograph [H, W, 3] in [0, 1], on the device of the scene.
        counts: Weights [H, W] in [0, 1] of the pixels; None: all count.
        extent: Of the scene, trained world units.
        expose: `Scene.as_photographed`.
    """
    motion = torch.zeros(6, dtype=torch.float64, device=photo.device, requires_grad=True)
    start = camera.world_to_cam.detach().to(photo.device).double()
    unit = torch.tensor([1.0, 1, 1, extent, extent, extent], dtype=torch.float64, device=photo.device)
    optimizer = torch.optim.Adam([motion])
    weights = torch.ones_like(photo[..., :1]) if counts is None else counts.to(photo)[..., None]
    area = 3 * weights.sum().clamp_min(1e-12)
    best, least = camera, float("inf")
    for i in range(STEPS):
        with torch.enable_grad():
            pose = exp_motion(motion * unit) @ start
            moved = camera if i == 0 else at_pose(camera, pose)
            with torch.no_grad():
                g = draws(moved, step, Mode.DRAW, rasterize.visible).gaussians
            g = attach(replace(g, means=g.means.detach(), quats=g.quats.detach()), pose)
            image = expose(rasterize(g, moved, background).image, moved)
            loss = ((image.clamp(0, 1) - photo).abs() * weights).sum() / area
        if loss.item() < least:
            best, least = moved, loss.item()
        if not loss.requires_grad:
            break  # nothing is visible
        (motion.grad,) = torch.autograd.grad(loss, [motion], allow_unused=True)
        if motion.grad is None:
            break
        optimizer.param_groups[0]["lr"] = RATE * (1 - i / STEPS)
        optimizer.step()
    return best
