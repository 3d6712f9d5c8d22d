"""Where photographs were taken, by what their cameras noted (GPS). COLMAP keeps it beside the
features."""

from __future__ import annotations

import math
import sqlite3
from collections.abc import Sequence
from contextlib import closing
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

EARTH = 6_371_000.0  # m, mean radius
NOISE = 30.0  # m; GPS is off by a few metres, so that it orders only photographs of places larger than this
WGS84 = 0  # COLMAP's number for latitude and longitude in degrees and altitude in metres


def read_positions(database: Path, names: Sequence[str]) -> NDArray[np.float64]:
    """Return the position of each photograph of COLMAP's database, east and north in metres from
    their mean [N, 2]; nan for one without. Altitudes are left out: they are off the most."""
    out = np.full((len(names), 2), np.nan)
    degrees = _read_priors(database)
    for i, name in enumerate(names):
        place = degrees.get(name)
        if place is not None and np.isfinite(place[:2]).all() and abs(place[0]) <= 90 and abs(place[1]) <= 180:
            out[i] = place[1], place[0]
    known = np.isfinite(out).all(1)
    if known.any():
        origin = out[known][0]
        away = out - origin
        away[:, 0] = (away[:, 0] + 180) % 360 - 180  # the short way around
        out = np.radians(away) * EARTH * np.array([math.cos(math.radians(origin[1])), 1.0])
        out -= np.mean(out[known], axis=0)
    return out


def _read_priors(database: Path) -> dict[str, NDArray[np.float64]]:
    """Return latitude, longitude and altitude by name, as COLMAP's database has them."""
    query = "SELECT images.name, position FROM images JOIN pose_priors ON corr_data_id = images.image_id WHERE coordinate_system = ?"
    with closing(sqlite3.connect(f"file:{database.as_posix()}?mode=ro", uri=True)) as there:
        try:
            found = there.execute(query, (WGS84,)).fetchall()
        except sqlite3.OperationalError:  # a COLMAP that keeps them otherwise
            return {}
    return {name: np.frombuffer(blob, np.float64) for name, blob in found if blob is not None and len(blob) == 24}


def find_near(positions: NDArray[np.float64], count: int) -> list[tuple[int, int]]:
    """Return pairs (i, j), i < j, of each photograph with the `count` taken nearest to it. None
    where the places are too close together for GPS to tell them apart."""
    known = np.flatnonzero(np.isfinite(positions).all(1))
    if len(known) <= count:
        return []
    places = positions[known]
    spread = np.quantile(np.linalg.norm(places - np.median(places, axis=0), axis=1), 0.9)
    if spread < NOISE:
        return []
    near = np.asarray(KDTree(places).query(places, count + 1)[1])
    pairs = {(min(i, int(j)), max(i, int(j))) for i, row in enumerate(near) for j in row if int(j) != i}
    return sorted((int(known[i]), int(known[j])) for i, j in pairs)
