"""Summarises a capture as plain values and prints the summary (`scene-experts info`)."""

from __future__ import annotations

from collections import Counter
from typing import Any

import torch
from rich.console import Console
from rich.table import Table
from rich.text import Text
from torch import Tensor

from scene_experts.core.reading.source import sentence
from scene_experts.data.views import Capture
from scene_experts.geometry.neighbours import median_neighbour_distance


def summarise(capture: Capture) -> dict[str, Any]:
    """Return the facts of a capture as plain values that JSON can hold. Reads no pixels.

    The keys include the kind, the numbers of views, their sizes in px, camera models, the number of
    points, the split, the resolution policy and the warnings. Lengths are in units of the trained
    world; `world` maps the capture's own frame to it.
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
        "depth_maps": sum(v.depth is not None for v in capture.views),
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
    """Return the median distance from a point of `xyz` [P, 3] to its nearest neighbour.

    With more than `exact` points, the median is estimated from 256 randomly chosen points to keep
    it fast.
    """
    if len(xyz) <= exact:
        return median_neighbour_distance(xyz)
    pick = torch.randperm(len(xyz), generator=torch.Generator().manual_seed(0))[:256]
    near = (xyz - xyz.mean(0)).float()  # centred, so single precision is enough for a statistic
    nearest = []
    for part in pick.split(16):
        distance = torch.cdist(near[part], near, compute_mode="donot_use_mm_for_euclid_dist")
        distance[torch.arange(len(part)), part] = float("inf")
        nearest.append(distance.amin(1))
    return float(torch.cat(nearest).median())


def print_summary(capture: Capture, console: Console) -> None:
    """Print the summary of a capture, one fact per row, followed by its warnings."""
    table = Table(box=None, show_header=False, padding=(0, 2, 0, 0))
    table.add_column(style="bold", no_wrap=True)
    table.add_column(overflow="fold")
    for key, value in summarise(capture).items():
        if key != "warnings":
            table.add_row(key.replace("_", " "), Text(sentence(format_value(value))))
    console.print(table)
    for warning in capture.warnings:
        console.print(f"warning: {warning}", style="yellow", markup=False, soft_wrap=True)


def format_value(value: object) -> str:
    """Format a value of the summary for a reader, e.g. 1234567 as "1,234,567" and True as "yes"."""
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, float):
        return f"{value:.6g}"
    if isinstance(value, int):
        return f"{value:,}"
    if isinstance(value, dict):
        return ", ".join(f"{k} {format_value(v)}" for k, v in value.items())
    if isinstance(value, (list, tuple)):
        return ", ".join(format_value(v) for v in value)
    return str(value)
