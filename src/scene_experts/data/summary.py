"""What `scene-experts info` says about a capture."""

from __future__ import annotations

from collections import Counter

import torch
from torch import Tensor

from scene_experts.data.views import Capture
from scene_experts.geometry.neighbours import median_neighbour_distance


def summarise(capture: Capture) -> dict:
    """Plain values: kind, views, sizes, camera models, points, extent, world, split, resolution, masks, warnings. Reads no pixels.

    Lengths are in trained units, except `world`, which says how those come from the capture's own.
    """
    sources, points = capture.images.sources, capture.points
    sizes = Counter(f"{v.camera.width}x{v.camera.height}" for v in capture.views)
    return {
        "name": capture.name,
        "root": str(capture.root),
        "kind": capture.kind,
        "views": len(capture.views),
        "train": len(capture.train),
        "test": len(capture.test),
        "split": capture.split,
        "resolution": capture.resolution,
        "sizes": dict(sizes.most_common()),
        "file_sizes": dict(Counter(f"{s.lens.width}x{s.lens.height}" for s in sources).most_common()),
        "camera_models": dict(Counter(s.lens.model for s in sources).most_common()),
        "undistorted": sum(s.lens.distorted for s in sources),
        "masks": sum(s.mask is not None for s in sources),
        "points": 0 if points is None else len(points.xyz),
        "median_neighbour_distance": None if points is None else neighbour_distance(points.xyz),
        "extent": capture.extent,
        "near": capture.views[0].camera.near,
        "world": {"scale": capture.world.scale, "shift": list(capture.world.shift)},
        "background": list(capture.background),
        "image_cache_limit_bytes": capture.images.cache_bytes,
        "decoded_bytes": sum(s.size[0] * s.size[1] * 3 for s in sources),
        "warnings": list(capture.warnings),
    }


def neighbour_distance(xyz: Tensor, exact: int = 100_000) -> float:
    """Median distance from a point to its nearest other point; beyond `exact` points that of 256 random ones, so that it stays quick."""
    if len(xyz) <= exact:
        return median_neighbour_distance(xyz)
    pick = torch.randperm(len(xyz), generator=torch.Generator().manual_seed(0))[:256]
    near = (xyz - xyz.mean(0)).float()  # a statistic: single precision about the middle is enough
    nearest = []
    for part in pick.split(16):
        distance = torch.cdist(near[part], near, compute_mode="donot_use_mm_for_euclid_dist")
        distance[torch.arange(len(part)), part] = float("inf")
        nearest.append(distance.amin(1))
    return float(torch.cat(nearest).median())
