"""Points from the depth maps of a capture: those of a phone's LiDAR, or of a program.

A depth map holds, for each pixel, the distance along the camera's axis. Each pixel becomes a point
with the colour of its photograph. Left out: pixels without depth, pixels that the map is not sure
of, and pixels at edges of depth, which lie between what is near and what is far.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image, ImageOps

from scene_experts.core.errors import InputError
from scene_experts.core.reading.budget import DEPTH, PHOTOGRAPH
from scene_experts.core.reading.pictures import opening_picture
from scene_experts.core.types import Points
from scene_experts.data.images import ORIENTATION, FrameSource, Size, fits, load_mask

MOST = 100_000  # points of a capture: as many as a reconstruction of many photographs has
PIXELS = 4 * MOST  # that are looked at
EDGE = 0.05  # relative step of depth to a neighbour, beyond which a pixel lies at an edge
CELL = 0.004  # of the median depth: points in one cell of this size become one


@dataclass(frozen=True)
class DepthFile:
    """A depth map of 16 bits, stored like its photograph."""

    path: Path
    unit: float
    """Units of the capture for a step of the file."""
    confidence: Path | None = None
    """A picture of the same size: the lighter, the surer."""


@dataclass(frozen=True)
class DepthPhoto:
    """A photograph with a depth map."""

    source: FrameSource
    world_to_cam: NDArray[np.float64]  # [4, 4]
    depth: DepthFile


def find_points(views: Sequence[DepthPhoto]) -> Points | None:
    """Return at most MOST points of depth maps, in the frame of the cameras; None if no pixel is
    left. Raises InputError if a file is damaged or fits its photograph not."""
    each = max(1, PIXELS // max(len(views), 1))
    parts = [read_points(view, each) for view in views]
    places, colors = (np.concatenate([part[k] for part in parts]) if parts else np.zeros((0, 3)) for k in (0, 1))
    if not len(places):
        return None
    away = places - places.min(0)
    cell = max(CELL * float(np.median(np.concatenate([part[2] for part in parts]))), float(away.max()) / 2**20)
    while True:
        x, y, z = np.floor(away / cell).astype(np.int64).T
        _, first = np.unique((x << 42) + (y << 21) + z, return_index=True)
        if len(first) <= MOST:
            break
        cell *= 1.2
    chosen = np.sort(first)
    return Points(torch.from_numpy(places[chosen]), torch.from_numpy(colors[chosen].astype(np.uint8)))


def read_points(view: DepthPhoto, most: int) -> tuple[NDArray[np.float64], NDArray[np.uint8], NDArray[np.float64]]:
    """Return at most `most` points [n, 3] of a depth map, where the photograph's mask counts, their
    colours [n, 3] and depths [n]."""
    source = view.source
    depth = read_upright(view.depth, source)
    height, width = depth.shape
    mask = load_mask(source)
    if mask is not None:
        depth[np.asarray(mask.resize((width, height), Image.Resampling.BOX)) < 128] = 0
    rows, columns = np.nonzero(depth)
    if not len(rows):
        return np.zeros((0, 3)), np.zeros((0, 3), np.uint8), np.zeros(0)
    step = -(-len(rows) // most)
    rows, columns = rows[step // 2 :: step], columns[step // 2 :: step]
    lens, z = source.lens.resize(width, height), depth[rows, columns]
    u, v = lens.undistort((columns + 0.5 - lens.cx) / lens.fx, (rows + 0.5 - lens.cy) / lens.fy)
    seen = np.isfinite(u) & np.isfinite(v)
    rows, columns, z = rows[seen], columns[seen], z[seen]
    local = np.stack([u[seen] * z, v[seen] * z, z], 1) - view.world_to_cam[:3, 3]
    with opening_picture(source.path, PHOTOGRAPH) as picture:
        picture.draft("RGB", (max(width, height),) * 2)
        upright = ImageOps.exif_transpose(picture) if source.turn else picture
        colors = np.asarray(upright.convert("RGB").resize((width, height), Image.Resampling.BOX))
    places = local @ view.world_to_cam[:3, :3]
    return places.astype(np.float64), colors[rows, columns], z


def read_upright(file: DepthFile, source: FrameSource) -> NDArray[np.float64]:
    """Read what is sure of a depth map, [H, W] in units of the capture and 0 elsewhere, turned as its
    photograph is. Raises InputError as `read_sure`."""
    turn = 1
    if source.turn:
        with opening_picture(source.path, PHOTOGRAPH) as photograph:
            turn = photograph.getexif().get(ORIENTATION, 1)
    upright = (source.lens.width, source.lens.height)
    stored = (upright[1], upright[0]) if turn in (5, 6, 7, 8) else upright
    if stored != upright:
        with opening_picture(file.path, DEPTH) as picture:
            if fits(picture.size, upright) and not fits(picture.size, stored):
                stored, turn = upright, 1  # the program has turned the map, and not the photograph
    values = read_sure(file, stored)
    picture = Image.fromarray(values.astype(np.float32))
    picture.getexif()[ORIENTATION] = turn
    return np.array(ImageOps.exif_transpose(picture), np.float64)


def read_sure(file: DepthFile, photograph: Size) -> NDArray[np.float64]:
    """Read a depth map [H, W] in units of the capture; 0 where it knows nothing, is not sure, or
    lies at an edge.

    photograph: Width and height of its photograph, as stored. Raises InputError if a file is
    damaged or does not fit.
    """
    depth = read_depth(file)
    height, width = depth.shape
    if not fits((width, height), photograph):
        raise InputError(
            f"expected the depth map {file.path} with the aspect ratio of its photograph ({photograph[0]}x{photograph[1]}), "
            f"found {width}x{height}; export both as the camera took them"
        )
    sure = (depth > 0) & ~is_edge(depth)
    if file.confidence is not None:
        confidence = read_values(file.confidence)
        if confidence.shape != depth.shape:
            raise InputError(
                f"expected {file.confidence} with the {width}x{height} px of its depth map, "
                f"found {confidence.shape[1]}x{confidence.shape[0]}; export both again"
            )
        sure &= confidence >= max(float(confidence.max()), 1.0)
    return np.where(sure, depth, 0.0)


def read_depth(file: DepthFile) -> NDArray[np.float64]:
    """Read a depth map [H, W] in units of the capture; 0 where it knows nothing. Raises InputError if
    its values are not whole numbers of more than 8 bits."""
    return read_values(file.path, deep=True) * file.unit


def read_values(path: Path, deep: bool = False) -> NDArray[np.float64]:
    """Read the values [H, W] of a picture with one channel. Raises InputError for other ones.

    deep: They must be whole numbers of more than 8 bits, as a map in small units is.
    """
    with opening_picture(path, DEPTH) as picture:
        if deep and not picture.mode.startswith("I"):
            found = {"F": "floating-point numbers", "L": "8 bits"}.get(picture.mode, f"a picture in {picture.mode}")
            raise InputError(
                f"expected the depth of {path} in 16 bits, in thousandths of the unit of the poses, found {found}; export the depth again"
            )
        if len(picture.getbands()) != 1 or picture.mode == "P":
            raise InputError(f"expected one value for each pixel of {path}, found a picture in {picture.mode}; export the depth again")
        return np.asarray(picture).astype(np.float64)


def is_edge(depth: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Return where a depth map [H, W] steps by more than EDGE of the depth to a neighbour with
    depth."""
    found = np.zeros(depth.shape, bool)
    for axis in (0, 1):
        a, b = (np.moveaxis(depth, axis, 0)[part] for part in (slice(None, -1), slice(1, None)))
        steps = (np.abs(a - b) > EDGE * np.minimum(a, b)) & (a > 0) & (b > 0)
        moved = np.moveaxis(found, axis, 0)
        moved[:-1] |= steps
        moved[1:] |= steps
    return found
