"""Reads clouds of points to start from, of any of the files that programs write beside their
poses."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from scene_experts.core.errors import InputError
from scene_experts.core.reading.budget import HEAD
from scene_experts.core.reading.source import opening
from scene_experts.core.types import Camera, Points
from scene_experts.data.projection import project
from scene_experts.data.readers import ply
from scene_experts.data.readers.colmap_model import read_points as read_colmap_points

NAMES = (  # of files of points, in the order in which they are preferred; capitals do not matter
    *("points3d.ply", "sparse_pc.ply", "pointcloud.ply", "point_cloud.ply", "points.ply", "pcd.ply", "cloud.ply", "dense.ply"),
    *("sparse.ply", "fused.ply"),
)
_SEEN = 0.05  # least share of a cloud that the cameras see, if it is in their frame
_SAMPLED = 2000  # points that decide about that


def from_arrays(xyz: NDArray[np.float64], rgb: NDArray[np.uint8]) -> Points | None:
    """Return points from positions [P, 3] and colours [P, 3], or None if there are none."""
    return Points(torch.from_numpy(xyz), torch.from_numpy(rgb)) if len(xyz) else None


def find_cloud(folders: Sequence[Path], warnings: list[str]) -> Path | None:
    """Return the PLY file with a usual name in the first of `folders` that has one, or None. Adds a
    warning if there are several."""
    for folder in folders:
        inside = [p for p in folder.iterdir() if p.name.lower() in NAMES and p.is_file()]
        found = sorted(inside, key=lambda p: (NAMES.index(p.name.lower()), p.name))
        if len(found) > 1:
            others = ", ".join(p.name for p in found[1:])
            warnings.append(f"{folder.name or folder} also holds {others} beside {found[0].name}; choose one with --points")
        if found:
            return found[0]
    return None


def read_points(path: Path, warnings: list[str]) -> Points | None:
    """Return the points of a PLY file or of COLMAP's points3D.bin or points3D.txt, in their own
    frame; None if it holds none.

    Adds warnings about colours: without any, points are grey. Raises InputError if the file is
    absent, damaged or of another format.
    """
    with opening(path, HEAD, "file of points") as source:
        is_ply = source.head(3) == b"ply"
    if is_ply:
        return from_arrays(*ply.read_points(path, warnings))
    if path.suffix.lower() not in (".bin", ".txt"):
        raise InputError(f"expected points in a PLY file, points3D.bin or points3D.txt, found {path}; convert it to PLY")
    table, notes = read_colmap_points(path)
    warnings += notes
    return from_arrays(np.array(table["xyz"], dtype=np.float64), np.array(table["rgb"]))


def check_frame(points: Points, cameras: Sequence[Camera], path: Path) -> list[str]:
    """Return a warning if hardly any of the points lies in a picture: they are then in another
    frame than the cameras (all in the capture's own frame, float64)."""
    xyz = points.xyz.double()[:: max(1, len(points.xyz) // _SAMPLED)]
    seen = torch.zeros(len(xyz), dtype=torch.bool)
    for camera in cameras:
        u, v, z = project(xyz, camera)
        seen |= (z > 0) & (u >= 0) & (u <= camera.width) & (v >= 0) & (v <= camera.height)
    share = float(seen.double().mean())
    if share >= _SEEN:
        return []
    return [
        f"only {100 * share:.1f} % of the points of {path.name} lie in a photograph: they seem to be in another frame than the cameras; "
        f"export both in one coordinate system, or start with --init random"
    ]
