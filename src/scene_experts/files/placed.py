"""Cameras for a scene without its capture: those of the cameras.json beside it, else rings of
cameras around the scene."""

from __future__ import annotations

import logging
import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from scene_experts.core.errors import InputError
from scene_experts.core.io import read_json
from scene_experts.core.reading import budget
from scene_experts.core.reading.numbers import FARTHEST, number
from scene_experts.core.reading.source import guarding
from scene_experts.core.types import Camera
from scene_experts.data.prepare import camera_extent, near_plane
from scene_experts.data.store import ImageStore
from scene_experts.data.views import Capture, Vector, View, World
from scene_experts.files.result_folder import iteration_of
from scene_experts.geometry.poses import FREE, look_at, make_pose
from scene_experts.view.path_files import check_pose, check_size

log: logging.Logger = logging.getLogger(__name__)
PHOTOGRAPHED, AROUND = "cameras.json", "cameras around the scene"  # `Capture.kind`
HEIGHTS = (5.0, 25.0, 50.0)  # degrees above the centre, one ring each
RING = 16  # cameras of a ring
FOV = 50.0  # degrees, vertical
SIZE = (800, 600)  # px
MARGIN = 1.2  # distance of the cameras, in that at which the ball around the scene fills the picture
MOST_CAMERAS = 400  # of a cameras.json, evenly chosen
_PROBES = 2000  # positions that say whether cameras look at the scene


def place_cameras(
    source: Path, positions: Tensor, world: World, origin: Vector = (0.0, 0.0, 0.0), background: Vector | None = None
) -> Capture:
    """A capture without photographs for the scene in `source`, all of its views for training and
    with free cameras, which have no appearance codes of their own.

    source: file or folder of the scene. positions: [N, 3] float64 of its rows, trained world. world:
    how that follows from the frame of the scene's capture. origin: place in the latter that the
    file and the cameras.json beside it are relative to. background: None: black. A cameras.json
    most of whose cameras see nothing of the scene, and a damaged one, is left aside with a warning.
    """
    folder = source if source.is_dir() else source.parent
    folder = folder.parent.parent if iteration_of(folder) is not None else folder
    listed = folder / "cameras.json"
    kind, cameras = PHOTOGRAPHED, {}
    if listed.is_file():
        try:
            cameras = _read_cameras(listed, world.seen_from(origin))
        except InputError as error:
            log.warning("cameras.json is left aside: %s", error)
    if cameras and not _mostly_see(list(cameras.values()), positions):
        log.warning("%s is left aside: most of its cameras do not see the scene in %s", listed, source)
        cameras = {}
    if not cameras:
        kind, cameras = AROUND, _rings(positions)
    views = tuple(View(name, camera, Path(name)) for name, camera in cameras.items())
    capture = Capture(
        name=folder.resolve().name if source.is_dir() else source.name.partition(".")[0],
        root=folder,
        kind=kind,
        views=views,
        points=None,
        train=tuple(range(len(views))),
        test=(),
        images=ImageStore((), 0),
        world=world,
        extent=1.0,
        resolution="as-is",
        split="none",
        background=background or (0.0, 0.0, 0.0),
    )
    extent = camera_extent(capture)
    near = near_plane(extent)
    views = tuple(replace(view, camera=replace(view.camera, near=near)) for view in views)
    return replace(capture, views=views, extent=extent)


def _rings(positions: Tensor) -> dict[str, Camera]:
    """Cameras on rings around the ball that holds 90 % of the positions [N, 3], looking at its
    centre; up is -y, as in captures with OpenCV axes."""
    centre, radius = torch.zeros(3, dtype=torch.float64), 1.0
    if len(positions):
        centre = positions.contiguous().median(0).values  # torch 2.13 reads beside an expanded tensor
        radius = float((positions - centre).norm(dim=1).sort().values[int(0.9 * (len(positions) - 1))]) or 1.0
    away = MARGIN * radius / math.sin(math.radians(FOV / 2))
    up = torch.tensor([0.0, -1.0, 0.0], dtype=torch.float64)
    focal = 0.5 * SIZE[1] / math.tan(math.radians(FOV / 2))
    out = {}
    for ring, height in enumerate(HEIGHTS):
        for i in range(RING):
            turn, lift = 2 * math.pi * (i + ring / len(HEIGHTS)) / RING, math.radians(height)
            level = torch.tensor([math.sin(turn), 0.0, -math.cos(turn)], dtype=torch.float64)
            place = centre + away * (math.cos(lift) * level + math.sin(lift) * up)
            out[f"around {len(out):02d}"] = _camera(look_at(place, centre, up), focal, focal, SIZE)
    return out


def _read_cameras(path: Path, world: World) -> dict[str, Camera]:
    """The cameras of a cameras.json by name, in the trained world. world: for positions as the file
    holds them."""
    entries: Any = read_json(path, "list of views")
    with guarding(path, budget.JSON, "list of views"):
        chosen = torch.linspace(0, len(entries) - 1, min(len(entries), MOST_CAMERAS)).round().long().tolist()
        out = {}
        for i in chosen:
            entry = entries[i]
            size = check_size(entry["width"], entry["height"])
            pose = torch.eye(4, dtype=torch.float64)
            pose[:3, :3] = torch.tensor(entry["rotation"], dtype=torch.float64)
            pose[:3, 3] = torch.tensor(entry["position"], dtype=torch.float64)
            check_pose(pose)
            fx, fy = (number(entry[name], name, 1e-3, FARTHEST) for name in ("fx", "fy"))
            middle = [number(entry.get(name, side / 2), name, -FARTHEST, FARTHEST) for name, side in zip(("cx", "cy"), size)]
            placed = world.from_input(pose[:3, 3])
            out[f"{i:04d} {entry.get('img_name', '')}"] = _camera(make_pose(placed, pose[:3, :3]), fx, fy, size, middle)
        return out


def _camera(pose: Tensor, fx: float, fy: float, size: tuple[int, int], middle: list[float] | None = None) -> Camera:
    cx, cy = middle or [side / 2 for side in size]
    return Camera(pose.float(), torch.tensor([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]]), *size, id=FREE)


def _mostly_see(cameras: list[Camera], positions: Tensor) -> bool:
    """Whether at least half of the cameras have some of the positions [N, 3] in their pictures."""
    probes = positions[:: max(1, len(positions) // _PROBES)]
    return 2 * sum(_sees(camera, probes) for camera in cameras) >= len(cameras)


def _sees(camera: Camera, positions: Tensor) -> bool:
    pose = camera.world_to_cam.double()
    x, y, z = (positions @ pose[:3, :3].T + pose[:3, 3]).unbind(1)
    u, v = camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy
    return bool(((z > 0) & (u > 0) & (u < camera.width) & (v > 0) & (v < camera.height)).any())
