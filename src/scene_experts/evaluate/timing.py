"""Measures how fast a trained scene draws: visibility filter, decode and rasterisation, without
reading or writing pictures.

Two decodes are measured: that of the frozen scene (`Scene.frozen`), which determines the frames per
second, and that of training.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass
from statistics import median
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from scene_experts.core.types import Camera, Mode

if TYPE_CHECKING:
    from scene_experts.render import Rasterizer
    from scene_experts.scene import Scene

WARM_UP = 5  # frames before the measurement begins
MOST_VIEWS = 32


@dataclass(frozen=True)
class Speed:
    """Medians over frames."""

    fps: float
    decode_ms: float  # visibility filter and decode
    raster_ms: float
    ordinary_fps: float  # with the decode of training
    ordinary_decode_ms: float
    frames: int  # measured frames
    device: str
    threads: int


@torch.no_grad()
def measure_speed(
    scene: Scene, cameras: Sequence[Camera], step: int, rasterize: Rasterizer, background: Tensor, budget: float = 10.0
) -> Speed:
    """Freeze the scene, draw up to 32 of `cameras` after a warm-up and return the median times.

    Args:
        cameras: Cameras on the scene's device.
        background: RGB [3] in [0, 1] on the scene's device.
        budget: Seconds after which the measurement stops early.
    """
    every = max(1, -(-len(cameras) // MOST_VIEWS))
    chosen = cameras[::every]
    frozen = scene.frozen(step)
    decode, raster, ordinary = [], [], []
    start, frame, enough = time.perf_counter(), 0, WARM_UP + max(len(chosen), 10)
    while frame < WARM_UP + 3 or (frame < enough and time.perf_counter() - start < budget):
        camera = chosen[frame % len(chosen)]
        began = _time_now(background)
        decoded = frozen(camera, step, Mode.DRAW, rasterize.visible)
        between = _time_now(background)
        rasterize(decoded.gaussians, camera, background)
        ended = _time_now(background)
        if frozen is not scene:
            scene(camera, step, Mode.DRAW, rasterize.visible)
        if frame >= WARM_UP:
            decode.append(between - began)
            raster.append(ended - between)
            ordinary.append(decode[-1] if frozen is scene else _time_now(background) - ended)
        frame += 1
    fps, ordinary_fps = (1 / median(d + r for d, r in zip(decodes, raster)) for decodes in (decode, ordinary))
    parts = [1e3 * median(times) for times in (decode, raster, ordinary)]
    return Speed(fps, parts[0], parts[1], ordinary_fps, parts[2], len(decode), str(background.device.type), torch.get_num_threads())


def _time_now(like: Tensor) -> float:
    """Return the time in seconds once the device of `like` has finished its work."""
    if like.is_cuda:
        torch.cuda.synchronize(like.device)
    return time.perf_counter()
