"""Distortions with a closed form, and their inverses, in normalised coordinates: the field-of-view,
division and enhanced unified models."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.floating]
LARGEST_ANGLE = math.radians(88.0)  # rays further from the axis are not usable on a flat image


def distort_fov(omega: float, u: Array, v: Array) -> tuple[Array, Array]:
    """Apply the field-of-view model of Devernay and Faugeras: r' = atan(2 r tan(omega/2)) /
    omega."""
    if abs(omega) < 1e-9:
        return u, v
    r = np.hypot(u, v)
    c = 2 * math.tan(omega / 2)
    s = np.where(r > 1e-8, np.arctan(c * r) / np.maximum(omega * r, 1e-12), c / omega)
    return u * s, v * s


def undistort_fov(omega: float, u: Array, v: Array) -> tuple[Array, Array]:
    """Invert `distort_fov`. Rays over 88 degrees from the axis are clamped to that."""
    if abs(omega) < 1e-9:
        return u, v
    r = np.hypot(u, v)
    c = 2 * math.tan(omega / 2)
    s = np.where(r > 1e-8, np.tan(np.minimum(omega * r, LARGEST_ANGLE)) / np.maximum(c * r, 1e-12), omega / c)
    return u * s, v * s


def distort_division(k: float, u: Array, v: Array) -> tuple[Array, Array]:
    """Apply the division model of Fitzgibbon, whose inverse is r / (1 + k r^2). NaN beyond its
    fold."""
    with np.errstate(invalid="ignore"):
        s = 2 / (1 + np.sqrt(1 - 4 * k * (u * u + v * v)))
    return u * s, v * s


def undistort_division(k: float, u: Array, v: Array) -> tuple[Array, Array]:
    """Invert `distort_division`. NaN where no ray gets to."""
    r2 = k * (u * u + v * v)
    s = 1 / np.where(np.abs(r2) < 1, 1 + r2, np.nan)
    return u * s, v * s


def distort_unified(alpha: float, beta: float, u: Array, v: Array) -> tuple[Array, Array]:
    """Apply the enhanced unified model of Khomutenko, Garcia and Martinet (2016)."""
    with np.errstate(all="ignore"):
        s = 1 / (alpha * np.sqrt(beta * (u * u + v * v) + 1) + 1 - alpha)
    return u * s, v * s


def undistort_unified(alpha: float, beta: float, u: Array, v: Array) -> tuple[Array, Array]:
    """Invert `distort_unified`. Rays over 88 degrees from the axis are clamped to that."""
    r2 = beta * (u * u + v * v)
    with np.errstate(all="ignore"):
        z = (1 - alpha * alpha * r2) / (alpha * np.sqrt(1 - (2 * alpha - 1) * r2) + 1 - alpha)
        s = 1 / np.maximum(z, np.hypot(u, v) / math.tan(LARGEST_ANGLE))  # NaN stays
    return u * s, v * s
