"""Camera paths through a capture: orbit, spiral, or along the captured poses. In the trained world,
OpenCV axes."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from scene_experts.core.errors import InputError
from scene_experts.core.types import Camera
from scene_experts.data.views import Capture
from scene_experts.geometry.poses import interpolate_poses, look_at, normalise, with_fov
from scene_experts.geometry.rotation import estimate_up

NAMES = ("auto", "orbit", "spiral", "views")
FACING = 0.7  # if the mean of the unit viewing directions is longer, the capture faces one way and an orbit would go behind the scene
MOST_POSES = 40  # captured poses that a path goes through
SEEN = 45.0  # degrees from the nearest captured viewing direction, beyond which a picture shows what no photograph does
UNSEEN = 0.1  # a larger share of frames that nobody photographed is too much
TRIED = 36  # frames by which a path is chosen
LEVEL = math.cos(math.radians(15))  # least cosine of the roll of an upright picture


@dataclass(frozen=True)
class CameraPath:
    """Cameras in order, at `fps` frames per second."""

    cameras: tuple[Camera, ...]
    fps: float = 24.0
    names: tuple[str, ...] = ()
    """The photograph of each camera; none for a path between photographs."""

    def __len__(self) -> int:
        return len(self.cameras)


@dataclass(frozen=True)
class CameraRig:
    """The training cameras of a capture: their poses, the point that they look at, and their common
    up direction."""

    centre: Tensor  # [3] point nearest to all optical axes
    up: Tensor  # [3] unit
    positions: Tensor  # [V, 3]
    rotations: Tensor  # [V, 3, 3] camera to world
    cameras: tuple[Camera, ...]

    @property
    def forward(self) -> Tensor:
        """Unit viewing directions [V, 3]."""
        return self.rotations[:, :, 2]


def analyse_cameras(capture: Capture) -> CameraRig:
    """Analyse the training cameras of a capture, or its test cameras if there are no training
    cameras."""
    cameras = tuple(capture.views[i].camera for i in (capture.train or capture.test))
    poses = torch.stack([c.world_to_cam.double() for c in cameras])
    rotations = poses[:, :3, :3].transpose(1, 2)
    positions = -(rotations @ poses[:, :3, 3:]).squeeze(2)
    up = estimate_up(rotations)
    forward = rotations[:, :, 2]
    # the point with the least sum of squared distances to all axes: sum (I - d d^T) (p - c) = 0;
    # parallel axes leave the depth open
    across = torch.eye(3, dtype=torch.float64) - forward[:, :, None] * forward[:, None, :]
    total = across.sum(0) / len(cameras)
    if torch.linalg.eigvalsh(total)[0] > 0.01:
        centre = torch.linalg.solve(total, (across @ positions[:, :, None]).squeeze(2).mean(0))
    else:
        direction = normalise(forward.mean(0))
        centre = positions.mean(0) + direction * median_depth(capture, positions.mean(0), direction)
    return CameraRig(centre, up, positions, rotations, cameras)


def choose_best_view(capture: Capture) -> int:
    """Return the index of the view that shows a capture best at first sight: the first of
    `rank_views`."""
    return rank_views(capture)[0]


def rank_views(capture: Capture) -> list[int]:
    """Return the indices of the views that show a capture well at first sight, best first, among the
    training views: those are drawn best.

    These views are upright (or the one nearest to upright) and not nearer to the centre than half
    of the training cameras (or the farthest). The first look most level and most directly at the
    centre.
    """
    rig = analyse_cameras(capture)
    middle = float((rig.positions - rig.centre).norm(dim=1).median())
    chosen = capture.train or capture.test
    rotations = torch.stack([capture.views[i].camera.world_to_cam[:3, :3].double().T for i in chosen])
    to_centre = rig.centre - torch.stack([capture.views[i].camera.position.double() for i in chosen])
    distance = to_centre.norm(dim=1)
    ups, across = -rotations[:, :, 1] @ rig.up, rotations[:, :, 0] @ rig.up
    level = ups / (ups.square() + across.square()).sqrt().clamp_min(0.3)  # cosine of the roll; looking straight down there is hardly one
    fits = level >= min(LEVEL, float(level.max()))
    fits &= distance >= min(0.999 * middle, float(distance[fits].max()))
    score = (rotations[:, :, 2] * to_centre).sum(1) / distance.clamp_min(1e-12) * ups
    order = score.argsort(descending=True, stable=True).tolist()
    return [chosen[i] for i in order if fits[i]]


def median_depth(capture: Capture, position: Tensor, direction: Tensor) -> float:
    """Return the median depth of the points in front of `position` along `direction`, or the extent
    if there are none."""
    if capture.points is None or not len(capture.points.xyz):
        return capture.extent
    along = (capture.points.xyz.double() - position) @ direction
    ahead = along[along > 0]
    return float(ahead.median()) if len(ahead) else capture.extent


def make_path(name: str, capture: Capture, frames: int, size: tuple[int, int] | None = None, fps: float = 24.0) -> CameraPath:
    """Make a camera path by name.

    Args:
        name: "orbit", "spiral", "views" (along the captured poses), or "auto" (see `choose_path`).
        frames: Number of cameras, at least 1.
        size: Width and height in px. None takes those of the camera with the median field of view.
        fps: Frames per second.

    Raises:
        InputError: for another name or fewer than one frame.
    """
    if frames < 1:
        raise InputError(f"expected at least 1 frame, found {frames}; increase --seconds")
    rig = analyse_cameras(capture)
    if name == "auto":
        name = choose_path(rig)
    if name not in NAMES:
        raise InputError(f"expected a path among {', '.join(NAMES)}, test or a file, found '{name}'; correct --path")
    poses = PATHS[name](rig, frames)
    model = median_camera(rig.cameras, size)
    return CameraPath(tuple(replace(model, world_to_cam=pose.float()) for pose in poses), fps)


def make_round(capture: Capture, frames: int) -> CameraPath:
    """Make a path that ends where it begins, as `choose_path` chooses it; along the captured poses it
    goes there and back. frames: Number of cameras, even and at least 2."""
    name = choose_path(analyse_cameras(capture))
    if name != "views":
        return make_path(name, capture, frames)
    there = make_path(name, capture, frames // 2 + 1)
    return replace(there, cameras=there.cameras + there.cameras[-2:0:-1])


def orbit(rig: CameraRig, frames: int) -> list[Tensor]:
    """Go once around the centre at the median height and distance of the cameras, looking at it.
    Returns world-to-camera matrices."""
    offset = rig.positions - rig.centre
    heights = offset @ rig.up
    flat = offset - heights[:, None] * rig.up
    radius, height = float(flat.norm(dim=1).median()), float(heights.median())
    first = normalise(flat[flat.norm(dim=1).argsort()[len(flat) // 2]])
    second = torch.linalg.cross(rig.up, first)
    out = []
    for i in range(frames):
        angle = 2 * math.pi * i / frames
        position = rig.centre + radius * (math.cos(angle) * first + math.sin(angle) * second) + height * rig.up
        out.append(look_at(position, rig.centre, rig.up))
    return out


def spiral(rig: CameraRig, frames: int, turns: int = 2, reach: float = 0.5) -> list[Tensor]:
    """Circle in front of the scene within the spread of the cameras, looking at the centre: for
    captures that face one way."""
    middle = rig.positions.mean(0)
    forward = normalise(rig.centre - middle)
    right = normalise(torch.linalg.cross(forward, rig.up))
    up = torch.linalg.cross(right, forward)
    offset = rig.positions - middle
    spread = [float(torch.quantile((offset @ axis).abs(), 0.9)) for axis in (right, up, forward)]
    out = []
    for i in range(frames):
        angle = 2 * math.pi * turns * i / frames
        along = (math.cos(angle), math.sin(angle), math.sin(angle / turns))
        position = middle + sum(reach * s * a * axis for s, a, axis in zip(spread, along, (right, up, forward)))
        out.append(look_at(position, rig.centre, rig.up))
    return out


def follow_views(rig: CameraRig, frames: int) -> list[Tensor]:
    """Move smoothly along the captured poses in the order of their names (at most MOST_POSES of
    them, evenly spread)."""
    count = min(len(rig.cameras), MOST_POSES)
    chosen = torch.linspace(0, len(rig.cameras) - 1, count).round().long()
    return interpolate_poses(rig.positions[chosen], rig.rotations[chosen], frames)


PATHS = {"orbit": orbit, "spiral": spiral, "views": follow_views}


def choose_path(rig: CameraRig) -> str:
    """Return the name of the path that fits the shape of a capture.

    Orbit if the cameras surround the scene, otherwise spiral, or views where a spiral looks where
    no photograph does.
    """
    names = ["spiral", "views"] if float(rig.forward.mean(0).norm()) > FACING else ["orbit", "spiral", "views"]
    for name in names[:-1]:
        along = torch.stack([pose[2, :3] for pose in PATHS[name](rig, TRIED)])
        if count_unseen_directions(along, rig) <= UNSEEN * TRIED:
            return name
    return names[-1]


def count_unseen(path: CameraPath, capture: Capture) -> int:
    """Return the number of cameras that look in a direction which no training camera has within
    SEEN degrees.

    They show backs of things that nobody photographed. Position is not considered.
    """
    along = torch.stack([camera.world_to_cam[2, :3].double() for camera in path.cameras])
    return count_unseen_directions(along, analyse_cameras(capture))


def count_unseen_directions(along: Tensor, rig: CameraRig) -> int:
    """Return how many of the unit directions [n, 3] no training camera has within SEEN degrees."""
    return int(((along @ rig.forward.T).amax(1) < math.cos(math.radians(SEEN))).sum())


def median_camera(cameras: Sequence[Camera], size: tuple[int, int] | None = None) -> Camera:
    """Return a free camera with the median vertical field of view of `cameras` and a centred
    principal point.

    size: Width and height in px. None takes those of the camera with the median field of view.
    """
    middle = sorted(cameras, key=lambda c: c.height / c.fy)[len(cameras) // 2]
    width, height = size or (middle.width, middle.height)
    return with_fov(middle, middle.fov, width, height)
