"""What several commands share: the choice of device and rasteriser, first words that stand for a flag."""

from __future__ import annotations

from typing import Literal

import torch

from scene_experts.core.errors import InputError
from scene_experts.render import Rasterizer, choose

Device = Literal["auto", "cpu", "cuda"]
Raster = Literal["auto", "reference", "cpu", "gsplat"]


def backend(device: Device, raster: Raster, antialias: bool, deterministic: bool) -> tuple[str, Rasterizer]:
    """The device and the rasteriser for it. Raises InputError when what was asked for is not there."""

    if device == "cuda" and not torch.cuda.is_available():
        raise InputError("expected a CUDA device, found none that torch can use; run `scene-experts doctor`, or use --device cpu")
    if device == "auto":
        device = "cuda" if torch.cuda.is_available() else "cpu"
    if deterministic:
        torch.use_deterministic_algorithms(True, warn_only=True)
    return device, choose(raster, device, antialias=antialias, deterministic=deterministic)


def positional(args: list[str], flag: str) -> list[str]:
    """Let the first argument stand for `flag`: `info CAPTURE` for `info --data CAPTURE`."""
    return [flag, *args] if args and not args[0].startswith("-") else args
