"""The choice of device and rasteriser, for commands and for the Python API."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Literal

import torch

from scene_experts.core.choices import Device, Raster
from scene_experts.core.errors import InputError
from scene_experts.render import Rasterizer, choose


def backend(device: Device, raster: Raster, antialias: bool, deterministic: bool) -> tuple[str, Rasterizer]:
    """The device and the rasteriser for it. Raises InputError for one that this machine does not have.

    deterministic: also make torch use its deterministic algorithms from now on, in the whole process.
    """
    device = device_of(device)
    if deterministic:
        torch.use_deterministic_algorithms(True, warn_only=True)
    return device, choose(raster, device, antialias=antialias, deterministic=deterministic)


def device_of(device: str) -> Literal["cpu", "cuda"]:
    """Return "cpu" or "cuda". "auto" is CUDA if torch finds it. Raises InputError for another name, and for "cuda" without CUDA."""
    available = torch.cuda.is_available()
    if device == "cuda" and not available:
        raise InputError("expected a CUDA device, found none that torch can use; run `scene-experts doctor`, or use --device cpu")
    if device == "cpu":
        return "cpu"
    if device in ("auto", "cuda"):
        return "cuda" if available else "cpu"
    raise InputError(f"expected a device among auto, cpu and cuda, found {device!r}; use one of those")


@contextmanager
def deterministic(on: bool) -> Iterator[None]:
    """Make torch use its deterministic algorithms inside the `with` block, where `on`; then restore the earlier choice."""
    before, warn_only = torch.are_deterministic_algorithms_enabled(), torch.is_deterministic_algorithms_warn_only_enabled()
    if on:
        torch.use_deterministic_algorithms(True, warn_only=True)
    try:
        yield
    finally:
        if on:
            torch.use_deterministic_algorithms(before, warn_only=warn_only)
