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

    Where the surrounding has depths, the inverse depth is interpolated between them. Elsewhere it
    is at most `far`: points must not stand in the space before a far background.

    Args:
        inverse: [H, W], inverse depths; 0: unknown.
        far: Inverse depth of the farthest plane.
    """
    height, width = inverse.shape
    edge = max(2, round(max(height, width) * SPACING))
    known = (inverse > 0).astype(np.float64)
    full = interpolate(inverse, known)
    around = box_mean(known, REACH * edge)
    full = np.where(around >= COVERED, full, np.minimum(full, far))
    rows, columns = np.meshgrid(np.arange(edge // 2, height, edge), np.arange(edge // 2, width, edge), indexing="ij")
    rows, columns = rows.ravel(), columns.ravel()
    hole = box_mean(known, edge)[rows, columns] < EMPTY
    rows, columns = rows[hole], columns[hole]
    return Holes(rows * width + columns, full[rows, columns], edge, len(hole))


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


def interpolate(values: Floats, weight: Floats) -> Floats:
    """Return `values` [H, W] where `weight` is 1, and elsewhere those of the next coarser picture in
    a pyramid of halves that has any (push-pull, Gortler et al. 1996); 0 where there are none."""
    if min(values.shape) == 1 or weight.all():
        total = weight.sum()
        return np.where(weight > 0, values, (values * weight).sum() / total if total > 0 else 0.0)
    coarse, held = halve(values * weight), halve(weight)
    mean = np.divide(coarse, held, out=np.zeros_like(coarse), where=held > 0)
    below = interpolate(mean, (held > 0).astype(np.float64))
    wide = np.repeat(np.repeat(below, 2, 0), 2, 1)[: values.shape[0], : values.shape[1]]
    return np.where(weight > 0, values, wide)


def halve(values: Floats) -> Floats:
    """Return the sums of the squares of 2 x 2 pixels; the border is padded with zeros."""
    height, width = values.shape
    padded = np.pad(values, ((0, height % 2), (0, width % 2)))
    return padded[0::2, 0::2] + padded[1::2, 0::2] + padded[0::2, 1::2] + padded[1::2, 1::2]
