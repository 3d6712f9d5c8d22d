"""Depth maps as training sees them: turned, undistorted and resized like their photographs."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from scene_experts.data.depth_maps import DepthFile, read_upright
from scene_experts.data.images import FrameSource, make_grid, target_size

LONGEST = 512  # px of the longer side: more than the map of a phone has


def read_map(file: DepthFile, source: FrameSource) -> Tensor:
    """Return a depth map [h, w] float32 in units of the capture; 0 where it is not known. It has
    the shape of the frame of `source`, with a longer side of at most 512 px.

    Raises InputError if a file is damaged or does not fit its photograph.
    """
    depth = torch.from_numpy(read_upright(file, source).astype(np.float32))
    places = make_grid(source.lens, target_size(f"longest:{LONGEST}", source.size))
    planes = torch.stack((depth, (depth > 0).float()))
    seen, known = torch.nn.functional.grid_sample(planes[None], places[None], padding_mode="zeros", align_corners=False)[0]
    return torch.where(known > 0.999, seen / known.clamp_min(0.5), 0.0)  # beside what is not known, nothing is
