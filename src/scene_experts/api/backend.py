"""The choice of device and rasteriser, for commands and for the Python API."""

from __future__ import annotations

import functools
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Literal

import torch

from scene_experts.core.choices import Device, Raster
from scene_experts.core.errors import InputError
from scene_experts.render import Rasterizer, choose
from scene_experts.render.gsplat_install import explain_missing


def backend(device: Device, raster: Raster, antialias: bool, deterministic: bool) -> tuple[str, Rasterizer]:
    """The device and the rasteriser for it. Raises InputError for one that this machine does not
    have.

    deterministic: also make torch use its deterministic algorithms from now on, in the whole
    process.
    """
    device = device_of(device, raster)
    if deterministic:
        torch.use_deterministic_algorithms(True, warn_only=True)
    return device, choose(raster, device, antialias=antialias, deterministic=deterministic)


def device_of(device: str, raster: Raster = "auto") -> Literal["cpu", "cuda"]:
    """Return "cpu" or "cuda".

    "auto" is CUDA if torch finds a device and the rasteriser `raster` draws on it. If only gsplat
    is missing for the rasteriser "auto", the CPU is used, and one warning says what to install.
    Raises InputError for another name, and for "cuda" without CUDA.
    """
    available = torch.cuda.is_available()
    if device == "cuda" and not available:
        raise InputError("expected a CUDA device, found none that torch can use; run `scene-experts doctor`, or use --device cpu")
    if device == "cpu":
        return "cpu"
    if device == "cuda":
        return "cuda"
    if device == "auto":
        return "cuda" if available and _draws_on_cuda(raster) else "cpu"
    raise InputError(f"expected a device among auto, cpu and cuda, found {device!r}; use one of those")


def _draws_on_cuda(raster: Raster) -> bool:
    """Whether CUDA is the device for `raster` if the user names none."""
    if raster in ("cpu", "reference"):
        return raster == "reference"
    reason = explain_missing()
    if reason is not None and raster == "auto":
        _warn(reason)
    return reason is None or raster == "gsplat"  # `gsplat` raises its own error when it draws


@functools.cache
def _warn(reason: str) -> None:
    warnings.warn(f"the GPU is not used, and the CPU is: {reason}", stacklevel=4)


@contextmanager
def deterministic(on: bool) -> Iterator[None]:
    """Make torch use its deterministic algorithms inside the `with` block, where `on`; then restore
    the earlier choice."""
    before, warn_only = torch.are_deterministic_algorithms_enabled(), torch.is_deterministic_algorithms_warn_only_enabled()
    if on:
        torch.use_deterministic_algorithms(True, warn_only=True)
    try:
        yield
    finally:
        if on:
            torch.use_deterministic_algorithms(before, warn_only=warn_only)
