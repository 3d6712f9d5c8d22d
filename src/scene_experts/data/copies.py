"""Photographs that are in a capture twice: a held-out copy of a training view makes scores too
good."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from scene_experts.core.errors import InputError, few
from scene_experts.core.reading.budget import PHOTOGRAPH
from scene_experts.core.reading.pictures import opening_picture
from scene_experts.data.colour import to_8_bit
from scene_experts.data.views import View

NEAR, ALIKE = 0.05, 0.9999  # of the median distance to the nearest view; cosine of the angle between two views (0.8 degrees)
SIDE, DIFFERENT = 48, 6.0  # px of the pictures that are compared, and their mean difference of 255 from which they are not copies
ROWS = 32  # views whose distances to all others are in memory together
MOST = 64  # pairs that are looked at


def tell_copies(views: Sequence[View]) -> list[str]:
    """Return a warning if photographs were taken from the same place in the same direction and look
    the same. Only such pairs are decoded."""
    if len(views) < 3:
        return []
    poses = np.stack([view.camera.world_to_cam.double().numpy() for view in views])
    centres = -np.einsum("vji,vj->vi", poses[:, :3, :3], poses[:, :3, 3])
    pairs = [(a, b) for a, b in _find_near(centres) if float(poses[a, 2, :3] @ poses[b, 2, :3]) > ALIKE]
    copies = sorted({views[b].name: views[a].name for a, b in pairs[:MOST] if _same(views[a], views[b])}.items())
    if not copies:
        return []
    named = few([f"{name} of {other}" for name, other in copies])
    return [f"{len(copies)} photographs are copies of others ({named}): a held-out copy scores too well; leave them out with --leave-out"]


def _find_near(centres: NDArray[np.float64]) -> list[tuple[int, int]]:
    """Return pairs of places that are much nearer to each other than places usually are."""
    count = len(centres)
    reach, nearest = np.empty(count), np.empty(count, np.int64)
    for top in range(0, count, ROWS):
        rows = np.arange(top, min(top + ROWS, count))
        square = np.zeros((len(rows), count))
        for axis in centres.T:
            square += (axis[rows, None] - axis[None]) ** 2
        square[rows - top, rows] = np.inf
        nearest[rows] = square.argmin(1)
        reach[rows] = np.sqrt(square[rows - top, nearest[rows]])
    close = np.nonzero(reach <= NEAR * np.median(reach))[0]
    return sorted({(min(a, b), max(a, b)) for a, b in zip(close.tolist(), nearest[close].tolist())})


def _same(a: View, b: View) -> bool:
    try:
        one, other = _small(a), _small(b)
    except InputError:  # told where the photograph is needed
        return False
    return float(np.abs(one - other).mean()) < DIFFERENT


def _small(view: View) -> NDArray[np.float64]:
    with opening_picture(view.path, PHOTOGRAPH, heic=True) as image:
        image.draft(None, (4 * SIDE, 4 * SIDE))
        return np.asarray(to_8_bit(image).convert("RGB").resize((SIDE, SIDE), Image.Resampling.BOX)).astype(np.float64)
