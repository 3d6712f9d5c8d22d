"""Points for the parts of a picture without depth: at the depth of what surrounds them, or far
away."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

SPACING = 1 / 25  # edge of the cells that get a point, of the longer side
REACH = 4  # edge of the surrounding that is looked at, in cells
EMPTY = 0.05  # share of a cell with depth below which it gets a point
COVERED = 0.15  # share of the surrounding with depth from which its depth is used

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Holes:
    """The cells of a picture that have no depth."""

    pixels: NDArray[np.int64]  # [n], the pixel in the middle of each
    inverse: Floats  # [n], inverse depth of its point
    edge: int  # of a cell, px
    cells: int  # with and without depth


def fill_holes(inverse: Floats, far: float) -> Holes:
    """Find the cells without depth, and a depth for each.

    Where the surrounding has depths, it is the nearest pixel's: a mean of near and far would lie in
    free space. Elsewhere it is at most `far`: points must not stand before a far background.

    Args:
        inverse: [H, W], inverse depths; 0: unknown.
        far: Inverse depth of what is far away.
    """
    height, width = inverse.shape
    edge = max(2, round(max(height, width) * SPACING))
    known = (inverse > 0).astype(np.float64)
    full = take_nearest(inverse)
    around = box_mean(known, REACH * edge)
    full = np.where(around >= COVERED, full, np.where(full > 0, np.minimum(full, far), far))
    rows, columns = np.meshgrid(np.arange(edge // 2, height, edge), np.arange(edge // 2, width, edge), indexing="ij")
    rows, columns = rows.ravel(), columns.ravel()
    hole = box_mean(known, edge)[rows, columns] < EMPTY
    rows, columns = rows[hole], columns[hole]
    return Holes(rows * width + columns, full[rows, columns], edge, len(hole))


def add_points(inverse: Floats, pixels: NDArray[np.int64], values: Floats) -> Floats:
    """Return the inverse depths [H, W] with those of points: `values` [n] at `pixels` [n]. A point
    counts for its pixel and the eight around it, where nothing is known; the nearest wins."""
    height, width = inverse.shape
    seen = np.zeros((height + 2, width + 2))
    rows, columns = pixels // width, pixels % width
    for down in range(3):
        for right in range(3):
            np.maximum.at(seen, (rows + down, columns + right), values)
    return np.where(inverse > 0, inverse, seen[1:-1, 1:-1])


def take_nearest(inverse: Floats) -> Floats:
    """Return `inverse` [H, W] with that of the nearest known pixel where it is 0; 0 if none is
    known."""
    from scipy.ndimage import distance_transform_edt  # takes long to import, and most trainings do not need it

    if not inverse.any():
        return inverse
    rows, columns = distance_transform_edt(inverse == 0, return_distances=False, return_indices=True)  # pyright: ignore[reportGeneralTypeIssues]
    return inverse[rows, columns]


def box_mean(values: Floats, edge: int) -> Floats:
    """Return the means [H, W] over squares of about `edge` px around each pixel, cut at the
    border."""
    half = max(1, edge // 2)
    for axis in (0, 1):
        n = values.shape[axis]
        sums = np.concatenate((np.zeros_like(values.take([0], axis)), values.cumsum(axis)), axis)
        low, high = np.maximum(np.arange(n) - half, 0), np.minimum(np.arange(n) + half + 1, n)
        shape = (-1, 1) if axis == 0 else (1, -1)
        values = (sums.take(high, axis) - sums.take(low, axis)) / (high - low).reshape(shape)
    return values
