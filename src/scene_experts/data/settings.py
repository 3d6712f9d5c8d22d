"""Which capture is read, and how: the options that `train`, `info` and `import` share."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

from scene_experts.arguments.option import Option
from scene_experts.core.fields import Range
from scene_experts.core.plain import lean


@dataclass(frozen=True)
class Data:
    """The capture and how it is read."""

    path: Annotated[Path, Option(name="data", short="-s", value="CAPTURE")]
    """Folder of the capture: a COLMAP folder (images/ and sparse/0/), a folder with
    transforms*.json or with the poses of another program, or catalog:SCENE for a scene that
    `scene-experts download` downloaded."""
    images: Annotated[str | None, Option(value="FOLDER")] = None
    """Image folder inside the capture, for example images_4."""
    resolution: Annotated[str, Option(short="-r", value="POLICY")] = "auto"
    """Size of the training pictures: as-is, factor:N (sides divided by N), longest:PX, cap1600
    (width at most 1600 px), share:S (a share of what cap1600 gives), inria:N (as factor:N from the
    folder images_N) or auto (cap1600)."""
    split: Annotated[str, Option(value="RULE")] = "auto"
    """Which views are held out: mod8 (every 8th), mod:N (every Nth), fold:K/N (every Nth from the
    Kth), first:N, none, files (as the capture's files say, or a test.txt or test_list.txt
    beside them) or auto (files if they say it, none with fewer than 12 views, else mod8)."""
    leave_out: Annotated[tuple[str, ...], Option(value="NAME")] = ()
    """Leave out these photographs: neither train on them nor hold them out. Their folder and
    extension may be omitted where the name stays unambiguous."""
    missing: Literal["error", "drop"] = "error"
    """What to do if the photograph of a view is missing: stop, or drop the view. Frames of a
    transforms.json are dropped in any case."""
    normalise: Literal["extent", "none"] = "extent"
    """extent: scale the world to a camera extent of 5 for the training; every exported file is
    scaled back. none: train in the capture's own units."""
    init: Literal["auto", "points", "dense", "random"] = "auto"
    """Start from the capture's 3D points, from denser ones that are computed from the training
    photographs (dense), or from random points. auto: dense where the recipe asks for it
    (--dense-views), else points, with some far away where it asks for them (--far-points)."""
    points: Annotated[Path | None, Option(value="FILE")] = None
    """Start from the points of this file instead: a PLY file, or points3D.bin or points3D.txt of
    COLMAP, in the frame of the capture's poses."""
    model: Annotated[str | None, Option(value="PATH")] = None
    """Which reconstruction of the capture is read if it has several: a folder (sparse/1) or a file
    of poses (cameras.xml) inside it. By default that with the most photographs."""
    max_views: Annotated[int | None, Range(1)] = None
    """Use at most this many views, evenly spread."""
    near: Annotated[float | None, Range(above=0, below=math.inf)] = None
    """Nearest depth that is drawn, in trained units; by default min(0.2, 0.02 x scene radius). The
    reference implementations use 0.2 in any unit."""
    ignore_principal_point: bool = False
    """Assume that the principal point is the centre of the picture, as the reference
    implementations do."""
    views: Annotated[Path | None, Option(value="FILE")] = None
    """Train only on the training views that this JSON list names. The world and the held-out views
    stay those of the whole capture."""
    background: Annotated[tuple[float, float, float] | None, Range(0, 1)] = None
    """Background colour, RGB; by default that of the kind of capture (white for NeRF-synthetic,
    else black)."""

    def settings(self) -> dict[str, Any]:
        """What differs from the defaults of how a capture is read, as plain JSON, without its
        path."""
        return {name: value for name, value in lean(self).items() if name != "path"}
