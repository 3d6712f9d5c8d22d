"""How large the photographs are that an iteration sees.

Before the details can be learned, half of the size shows as much of the scene for fewer pixels
(DashGaussian, CVPR 2025, shows why; the schedule here is simpler: one step, where growth ends).
"""

from __future__ import annotations

from typing import Protocol

from scene_experts.core.types import Camera
from scene_experts.training.config import Train

LEAST = 800
"""Longest side of a photograph, px, from which it is seen at half its size. For smaller ones the decode of
the scene takes most of the time."""


class PictureSize(Protocol):
    """A camera, as far as the size of its pictures is concerned."""

    @property
    def width(self) -> int:
        """Pixels of a row."""
        ...

    @property
    def height(self) -> int:
        """Rows."""
        ...


def is_shrunk(camera: PictureSize) -> bool:
    """Whether the photograph of a training view is large enough to be seen at half its size at
    first."""
    return max(camera.width, camera.height) >= LEAST


def shrink(cfg: Train, number: int, camera: Camera) -> tuple[Camera, int]:
    """Return the camera of a training view as iteration `number` sees it, and by how much its
    photograph is made smaller. cfg: scaled."""
    by = 2 if number <= cfg.half_until and is_shrunk(camera) else 1
    return camera.shrunk(by), by
