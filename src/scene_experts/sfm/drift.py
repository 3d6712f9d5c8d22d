"""How much the exposure of photographs differs, by the points that several of them show.

The colour of a point in a reconstruction is its mean over the photographs that show it. For each
photograph, the median over its points of log2 (its own colour / the point's) says how many stops it
is brighter than the others.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from scene_experts.core.errors import InputError
from scene_experts.core.io import read_json
from scene_experts.core.reading.budget import CAPTURED, Damaged
from scene_experts.core.reading.numbers import number
from scene_experts.core.reading.pictures import opening_picture
from scene_experts.data.readers.colmap_model import Model, read_model

DRIFT = 0.3
"""Stops, as standard deviation over the photographs, from which a training learns exposures: with
0.37 (brighton) it gains 0.1 dB, with 0.34 that were made (fox) 1.4 dB; with less it gains on one
capture and loses on another (results/exposure.md)."""
KEY, NOTE = "exposure_drift", "capture.json"
GAMMA = 2.2  # of the response of cameras, about
FEWEST = 30  # points of a photograph that tell its exposure
DARK, LIGHT = 0.05, 0.95  # between which colours count
SIDE = 800  # px of the longest side at which photographs are looked at


def measure_drift(folder: Path, images: Path) -> float | None:
    """Return the standard deviation of the exposures of photographs in stops, from the COLMAP model
    in `folder` and the photographs in `images`; None if fewer than 3 photographs tell theirs, or a
    file cannot be read."""
    try:
        stops = find_stops(read_model(folder, observations=True), images)
    except InputError:
        return None
    return float(np.std(list(stops.values()))) if len(stops) >= 3 else None


def find_stops(model: Model, images: Path) -> dict[str, float]:
    """Return the stops by which each photograph is brighter than the others that show its
    points."""
    order = np.argsort(model.ids)
    ids, colors, stops = model.ids[order], model.rgb[order] / 255, dict[str, float]()
    for image in model.images:
        places, points = model.observations.get(image.id, (np.zeros((0, 2)), np.zeros(0, np.int64)))
        row = np.searchsorted(ids, points).clip(max=max(len(ids) - 1, 0))
        known = (points >= 0) & (ids[row] == points) if len(ids) else np.zeros(len(points), bool)
        if known.sum() < FEWEST:
            continue
        theirs = colors[row[known]]
        own = look(images / image.name, places[known], (model.cameras[image.camera_id].width, model.cameras[image.camera_id].height))
        counts = ((np.minimum(own, theirs) > DARK) & (np.maximum(own, theirs) < LIGHT)).all(1)
        if counts.sum() >= FEWEST:
            stops[image.name] = float(GAMMA * np.median(np.log2(own[counts] / theirs[counts]).mean(1)))
    return stops


def look(path: Path, places: NDArray[np.float64], size: tuple[int, int]) -> NDArray[np.float64]:
    """Return the colours [n, 3] in [0, 1] of a photograph at places [n, 2] in px of `size`."""
    with opening_picture(path, CAPTURED) as picture:
        picture.draft("RGB", (SIDE, SIDE))
        small = picture.convert("RGB")
        small.thumbnail((SIDE, SIDE))
        pixels = np.asarray(small)
    x, y = ((places[:, k] * small.size[k] / size[k]).astype(int).clip(0, small.size[k] - 1) for k in (0, 1))
    return pixels[y, x] / 255


def read_drift(capture: Path) -> float | None:
    """Return the drift in stops that `capture` has measured; None if it has not."""
    note = capture / NOTE
    try:
        found = read_json(note, "note of a capture") if note.is_file() else None
        value = found.get(KEY) if isinstance(found, dict) else None
        return None if value is None else number(value, KEY, 0, 100)
    except (InputError, Damaged):
        return None


def drifts(capture: Path) -> bool:
    """Return whether a training on a capture learns exposures: what `capture` has measured says
    so."""
    return (read_drift(capture) or 0) >= DRIFT


def warn_of_steady(capture: Path) -> str | None:
    """Return a warning for a training that learns exposures although `capture` has found them
    alike."""
    drift = read_drift(capture)
    if drift is None or drift >= DRIFT:
        return None
    return f"the exposures of {capture} differ by {drift:.2f} stops only: --exposure may lose 0.1 to 0.2 dB; leave it out below {DRIFT}"
