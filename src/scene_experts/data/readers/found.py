"""What a reader of one kind of capture finds in its files, before anything is decided."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from scene_experts.core.types import Points
from scene_experts.data.lens import Lens
from scene_experts.data.views import Kind

Colour = tuple[float, float, float]


@dataclass(frozen=True)
class Posed:
    """A view as its files state it."""

    name: str
    path: Path
    lens: Lens | None  # None: a horizontal angle of view instead, see `angle`
    world_to_cam: NDArray[np.float64]  # [4, 4]
    mask: Path | None = None
    angle: float = 0.0  # radians
    test: bool = False


@dataclass(frozen=True)
class Found:
    """What a reader of one kind of capture hands to `load`."""

    kind: Kind
    posed: list[Posed]
    points: Points | None
    warnings: list[str]
    over: Colour | None = None  # alpha is composited over this; None: alpha is a mask
    points_from: str = "points3D.bin or points3D.txt"  # named in the error where there are none
