"""The order of Gaussians along the Morton curve: neighbours in space become neighbours in the file, where they compress well."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from scene_experts.files.anchors.lattice_code import AXIS_BITS, morton


def morton_order(means: Tensor) -> Tensor:
    """Rows [N] of positions [N, 3] in the order of the curve through their bounding box; ties keep their order."""
    xyz = means.double().numpy()
    if not len(xyz):
        return torch.zeros(0, dtype=torch.int64)
    low = xyz.min(0)
    span = (xyz.max(0) - low).max()
    cells = ((xyz - low) * (((1 << AXIS_BITS) - 1) / (span if span > 0 else 1.0))).astype(np.int64)
    return torch.from_numpy(np.argsort(morton(cells), kind="stable"))
