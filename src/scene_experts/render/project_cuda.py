"""Radii of Gaussians by the 3 sigma rule on CUDA: one kernel instead of the 270 of
`reference.project`."""

from __future__ import annotations

import importlib
from functools import cache

import torch
from torch import Tensor

from scene_experts.core.types import Camera
from scene_experts.native import triton
from scene_experts.render.reference import BLUR, TILE

BLOCK = 256


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
    M = means.shape[0]
    out = means.new_empty(M, dtype=torch.int32)
    if M == 0:
        return out
    camera = camera.to(means.device, torch.float32)
    means, scales = means.contiguous(), scales.contiguous()
    rotations = means if quats is None else quats.contiguous()  # not read if the Gaussians are not rotated
    tensors = (means, rotations, scales, camera.world_to_cam.contiguous(), out, out if extents is None else extents)
    _launch(quats is not None, extents is not None)((-(-M // BLOCK),), *tensors, M, *_numbers(camera))
    return out


def _numbers(camera: Camera) -> tuple[float, ...]:
    """Return what the kernel reads of a camera besides its place; kept with the camera."""
    known = camera.__dict__.get("of_radii")
    if known is None:
        fx, fy, cx, cy = camera.pinhole
        margin_x, margin_y = 0.3 * camera.width / (2 * fx), 0.3 * camera.height / (2 * fy)
        limits = (-cx / fx - margin_x, (camera.width - cx) / fx + margin_x, -cy / fy - margin_y, (camera.height - cy) / fy + margin_y)
        picture = (float(-(-camera.width // TILE) * TILE), float(-(-camera.height // TILE) * TILE))
        known = camera.__dict__["of_radii"] = (float(camera.near), fx, fy, cx, cy, *limits, *picture)
    return known


@cache
def _launch(rotated: bool, masked: bool) -> triton.Launch:
    kernel = importlib.import_module("scene_experts.render.triton_project").radii
    return triton.Launch(kernel, BLUR=BLUR, ROTATED=rotated, MASKED=masked, B=BLOCK)
