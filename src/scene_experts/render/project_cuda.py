"""Radii of Gaussians by the 3 sigma rule on CUDA: one kernel instead of the 270 of
`reference.project`."""

from __future__ import annotations

import importlib

import torch
from torch import Tensor

from scene_experts.core.types import Camera
from scene_experts.native import triton
from scene_experts.render.reference import BLUR, TILE

BLOCK = 256


@torch.no_grad()
def find_radii(means: Tensor, quats: Tensor | None, scales: Tensor, camera: Camera, extents: Tensor | None = None) -> Tensor:
    """Return the radii [M] int32 of `reference.project`, px, 0 for Gaussians that are not drawn.

    The tensors are float32 on one device, on which Triton runs.

    Args:
        means: [M, 3] world.
        quats: [M, 4] unit quaternions. None: the Gaussians are not rotated.
        scales: [M, 3] standard deviations.
        camera: The camera, with tensors on any device.
        extents: [1, M, 2] int32, contiguous. The rows of Gaussians that are not drawn are set to 0.
    """
    M = len(means)
    out = torch.empty(M, dtype=torch.int32, device=means.device)
    if M == 0:
        return out
    camera = camera.to(means.device, torch.float32)
    fx, fy, cx, cy = camera.pinhole
    margin_x, margin_y = 0.3 * camera.width / (2 * fx), 0.3 * camera.height / (2 * fy)
    limits = (-cx / fx - margin_x, (camera.width - cx) / fx + margin_x, -cy / fy - margin_y, (camera.height - cy) / fy + margin_y)
    picture = (float(-(-camera.width // TILE) * TILE), float(-(-camera.height // TILE) * TILE))
    means, scales = means.contiguous(), scales.contiguous()
    rotations = means if quats is None else quats.contiguous()  # not read if the Gaussians are not rotated
    tensors = (means, rotations, scales, camera.world_to_cam.contiguous(), out, out if extents is None else extents)
    numbers = (M, float(camera.near), fx, fy, cx, cy, *limits, *picture)
    kernel = importlib.import_module("scene_experts.render.triton_project").radii
    sizes = {"BLUR": BLUR, "ROTATED": quats is not None, "MASKED": extents is not None, "B": BLOCK}
    triton.launch(kernel, (-(-M // BLOCK),), *tensors, *numbers, **sizes)
    return out
