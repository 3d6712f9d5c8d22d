"""How large the photographs are that an iteration sees.

Before the details can be learned, half of the size shows as much of the scene for fewer pixels
(DashGaussian, CVPR 2025, shows why; the schedule here is simpler: one step, where growth ends).
"""

from __future__ import annotations

from collections.abc import Sequence
from statistics import fmean

from scene_experts.core.types import Camera
from scene_experts.training.config import Train

LEAST = 800
"""Longest side of a photograph, px, from which it is seen at half its size. For smaller ones the decode of
the scene takes most of the time (results/performance.md)."""


PIXELS = 4.0
"""A megapixel adds this share to the time of an iteration on a CPU that draws no pixel: 12.1 iterations a
second at half of 0.36 megapixels and 6.6 as they are (fox, 800 px)."""


def slow_down(width: int, height: int) -> float:
    """Return how many times longer an iteration on a CPU takes with a photograph of this size than with
    what is seen of it at first."""
    pixels = width * height / 1e6
    return (1 + PIXELS * pixels) / (1 + PIXELS * pixels / 4) if max(width, height) >= LEAST else 1.0


def find_slower(cfg: Train, cameras: Sequence[Camera]) -> float:
    """Return how many times longer the iterations after `cfg.half_until` take, in the mean of the
    training cameras; 1 if no photograph is seen smaller before."""
    if not cfg.half_until or not cameras:
        return 1.0
    return fmean(slow_down(camera.width, camera.height) for camera in cameras)


def shrink(cfg: Train, number: int, camera: Camera) -> tuple[Camera, int]:
    """Return the camera of a training view as iteration `number` sees it, and by how much its
    photograph is made smaller. cfg: scaled."""
    by = 2 if number <= cfg.half_until and max(camera.width, camera.height) >= LEAST else 1
    return camera.shrunk(by), by
