"""Copies to a device and launches of Triton kernels, as of commit da16e27."""

from __future__ import annotations

import importlib.util
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from typing import Any

import torch
from torch import Tensor

from scene_experts.core.types import Camera


def upload(tensor: Tensor, device: torch.device | str | None = None, dtype: torch.dtype | None = None) -> Tensor:
    """Return `tensor` on `device` with `dtype`, through page-locked memory."""
    if device is not None and torch.device(device).type == "cuda" and tensor.device.type == "cpu" and not tensor.requires_grad:
        return tensor.contiguous().pin_memory().to(device, non_blocking=True).to(dtype=dtype or tensor.dtype)
    return tensor.to(device=device, dtype=dtype)


def upload_camera(camera: Camera, device: str) -> Camera:
    """Return a camera with its tensors on `device`, copied anew."""
    return replace(camera, world_to_cam=upload(camera.world_to_cam, device), K=upload(camera.K, device))


@cache
def has_triton() -> bool:
    return importlib.util.find_spec("triton") is not None


def covers(*tensors: Tensor) -> bool:
    """Whether the tensors are float32 on CUDA, so that the Triton kernels are used."""
    return all(t.device.type == "cuda" and t.dtype == torch.float32 for t in tensors) and has_triton()


def launch(kernel: Any, grid: tuple[int, ...], *arguments: Any, **sizes: Any) -> None:
    """Launch a kernel by Triton's own way. `sizes` are the compile-time constants."""
    first = next(a for a in arguments if isinstance(a, Tensor))
    run: Callable[..., Any] = kernel[grid]
    if first.device.type != "cuda":  # Triton's interpreter
        run(*arguments, **sizes)
        return
    with torch.cuda.device(first.device):
        run(*arguments, **sizes)
