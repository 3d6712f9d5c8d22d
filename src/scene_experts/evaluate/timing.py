"""How fast a trained scene draws: visibility filter + decode + rasterise, without reading or writing pictures."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass
from statistics import median
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from scene_experts.types import Camera

if TYPE_CHECKING:
    from scene_experts.render import Rasterizer
    from scene_experts.scene import Scene

WARM_UP = 5  # first frames that do not count
MOST_VIEWS = 32  # enough for a median


@dataclass(frozen=True)
class Speed:
    """Medians over frames."""

    fps: float
    decode_ms: float  # visibility filter and decode
    raster_ms: float
    frames: int  # that counted
    device: str
    threads: int


@torch.no_grad()
def measure(scene: Scene, cameras: Sequence[Camera], step: int, rasterize: Rasterizer, background: Tensor, budget: float = 10.0) -> Speed:
    """Draw up to 32 of `cameras` (on the scene's device), each once or more after the warm-up; stop early after `budget` seconds."""
    every = max(1, -(-len(cameras) // MOST_VIEWS))
    chosen = cameras[::every]
    decode, raster = [], []
    start, frame, enough = time.perf_counter(), 0, WARM_UP + max(len(chosen), 10)
    while frame < WARM_UP + 3 or (frame < enough and time.perf_counter() - start < budget):
        camera = chosen[frame % len(chosen)]
        began = _now(background)
        decoded = scene(camera, step, False, rasterize.visible)
        between = _now(background)
        rasterize(decoded.gaussians, camera, background)
        ended = _now(background)
        if frame >= WARM_UP:
            decode.append(between - began)
            raster.append(ended - between)
        frame += 1
    total = median(d + r for d, r in zip(decode, raster))
    return Speed(1 / total, 1e3 * median(decode), 1e3 * median(raster), len(decode), str(background.device.type), torch.get_num_threads())


def _now(like: Tensor) -> float:
    """The time once the device that holds `like` has finished what it was given."""
    if like.is_cuda:
        torch.cuda.synchronize(like.device)
    return time.perf_counter()
