"""The options of an export, as one value. This module loads no torch: the help of the command line
reads it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal

from scene_experts.arguments.option import Option
from scene_experts.core.fields import Range

MAX_DEGREE = 3  # of spherical harmonics in any format


@dataclass(frozen=True)
class Options:
    """What to write, and whether to measure it. All but `measure`, `quality`, `target_mb` and
    `photographs` are for formats of standard Gaussians."""

    measure: bool = True
    """Draw the held-out views from the run and from the file, and say what the file costs in
    PSNR."""
    quality: float = 0.2
    """compact, html, streamed-html: dB of PSNR that the training views may lose; held-out views lose
    less."""
    target_mb: float = 0.0
    """compact, html, streamed-html: write a file of at most this many megabytes (10^6 bytes), as good
    as it can be, in place of --quality; 0: any size."""
    sh_degree: int = MAX_DEGREE
    """Standard files: degree of the spherical harmonics, 0 (smallest file) to 3 (best)."""
    max_gaussians: int = 0
    """Standard files: keep at most this many Gaussians, those that contribute most to the pictures;
    0 keeps all."""
    prune: float = 0.0
    """Standard files: share of all contributions to the pictures to leave out, smallest first, 0 to
    below 1 (0.02 costs little)."""
    refine: int | None = None
    """Standard files: iterations that fit all parameters to the run's pictures; by default 200
    for up to 20 training views, else 200 to 1000, by how far the means over the views are from
    them. 0 keeps the means, which takes seconds."""
    frame: Literal["capture", "trained"] = "capture"
    """Standard files: the capture's own frame, or the frame that the scene was trained in."""
    crop: Annotated[str | None, Option(value="SHAPE")] = None
    """Standard files: keep what is inside sphere:RADIUS (around the point that the cameras look at;
    1.2x counts in their distance from it), sphere:X,Y,Z,RADIUS or box:X0,Y0,Z0,X1,Y1,Z1, in the
    units of the capture's poses."""
    floaters: Literal["keep", "remove"] = "keep"
    """Standard files: remove Gaussians that no training photograph supports: those that cover less
    than 0.3 pixels of each, and large, faint ones that fewer than 4 show."""
    title: str | None = None
    """html: title of the page; by default it names the capture."""
    cells: Annotated[int, Range(8, 2048)] = 256
    """mesh: voxels along its longest side."""
    levels: bool = False
    """Standard files: one file per level of detail, each without the finer levels."""
    photographs: bool = False
    """html of a scene with networks: put small photographs into the page, which fade in at their
    places; about 0.1 MB more."""


DEFAULT = Options()
