"""The tracks of a capture: where its photographs show the points of its reconstruction."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from numpy.typing import NDArray

from scene_experts.data.lens import PANORAMA_VIEW
from scene_experts.data.match import to_relative_name
from scene_experts.data.readers.colmap_model import read_model
from scene_experts.data.views import Capture
from scene_experts.geometry.bundle import Observations


def read_tracks(capture: Capture, views: Sequence[int]) -> tuple[NDArray[np.float64], Observations] | None:
    """Return the points [P, 3] of the reconstruction in the trained world and what `views` show of
    them, by their place in `views`; None if the reconstruction has no tracks.

    Only COLMAP's have. Panoramas count as without. Raises InputError if a file cannot be read.
    """
    if capture.model is None:
        return None
    model = read_model(capture.model, observations=True)
    order = np.argsort(model.ids)
    ids, images = model.ids[order], {to_relative_name(image.name): image for image in model.images}
    found: list[tuple[NDArray, ...]] = []
    for place, index in enumerate(views):
        view, lens = capture.views[index], capture.images.sources[index].lens
        image = images.get(view.name)
        if image is None or image.id not in model.observations or lens.model == PANORAMA_VIEW or not len(ids):
            continue
        xy, points = model.observations[image.id]
        row = np.searchsorted(ids, points).clip(max=len(ids) - 1)
        known = ids[row] == points
        if not known.any():
            continue
        stored = model.cameras[image.camera_id]
        x, y = (xy[known] * (lens.width / stored.width, lens.height / stored.height)).T
        uv = np.stack(lens.undistort((x - lens.cx) / lens.fx, (y - lens.cy) / lens.fy), 1)
        inside = np.isfinite(uv).all(1)
        n = int(inside.sum())
        focal = np.tile([lens.fx, lens.fy], (n, 1))  # px of the file
        found.append((np.full(n, place), order[row[known][inside]], uv[inside], focal))
    if not found:
        return None
    xyz = capture.world.from_input(torch.from_numpy(model.xyz)).numpy()
    return xyz, Observations(*map(np.concatenate, zip(*found)))
