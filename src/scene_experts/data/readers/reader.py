"""The interface of a capture reader: what it is asked for and what it returns."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal, Protocol

import numpy as np
from numpy.typing import NDArray

from scene_experts.core.types import Points
from scene_experts.data.depth_maps import DepthFile
from scene_experts.data.lens import Lens
from scene_experts.data.views import Vector


@dataclass(frozen=True)
class ReadOptions:
    """Choices of the user that a reader may need."""

    images: str | None = None  # folder of the photographs, relative to the capture; None: the folder that the files state
    background: Vector | None = None  # RGB in [0, 1]; None: the default of the format
    missing: Literal["error", "drop"] = "error"  # what to do if photographs are absent
    model: Path | None = None  # the reconstruction or file of poses to read; None: the reader chooses
    points: bool = True  # False: the points are not used and need not be read


@dataclass(frozen=True)
class PosedImage:
    """A photograph with its camera, as the files of a capture state them."""

    name: str  # relative path with extension
    path: Path
    lens: Lens | None  # None: only the horizontal field of view is known, see `angle`
    world_to_cam: NDArray[np.float64]  # [4, 4], OpenCV axes (x right, y down, z forward)
    mask: Path | None = None  # file that the capture names as its mask; others are found by their names
    angle: float = 0.0  # horizontal field of view in radians, used if `lens` is None
    test: bool = False  # the files name it as a test view
    depth: DepthFile | None = None  # its depth map
    turned: Lens | None = None  # the lens if the program has turned the photograph by its EXIF orientation, where the files do not say


@dataclass(frozen=True)
class RawCapture:
    """A capture as its files state it, before it is split, scaled or normalised.

    The defaults of the last fields fit a format that states neither a split nor the place of the
    scene.
    """

    images: list[PosedImage]
    points: Points | None  # in the capture's own frame
    warnings: list[str]
    alpha_over: Vector | None = None  # composite transparent pixels over this colour; None: use alpha as a mask
    points_source: str = "the capture's files"  # named in the error message if there are no points
    states_split: bool = False  # the format divides the views into training and test views
    random_points: bool = False  # the format has no points: without others, training starts from random ones
    cloud: Path | None = None  # the file of points, if nothing says that its frame is that of the cameras
    model: Path | None = None  # folder of the reconstruction, if it is not that of the capture
    applied: object = None  # rows of the 3x4 matrix that turned the reconstruction into this frame, as the files state it; None: none
    applied_scale: object = None  # factor of the reconstruction's unit, as the files state it; None: 1
    bounds: tuple[Vector, Vector] | None = None  # lower and upper corner of the scene; random points fill it if there are none


class Reader(Protocol):
    """Reads one kind of capture. A module-level object or an instance of a class can be a
    reader."""

    @property
    def name(self) -> str:
        """Name of the kind, e.g. "colmap"."""
        ...

    @property
    def files(self) -> str:
        """The files by which a user recognises the kind, for error messages, e.g.
        "transforms.json"."""
        ...

    def recognise(self, folder: Path) -> bool:
        """Return whether `folder` holds a capture of this kind. It must be fast and must not raise
        for unreadable content."""
        ...

    def read(self, folder: Path, options: ReadOptions) -> RawCapture:
        """Read the capture in `folder`. Raises InputError if it cannot be used."""
        ...
