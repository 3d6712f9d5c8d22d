"""Camera paths: around a scene, along a spiral, through the captured poses, through keyframes. All in the trained world, OpenCV axes."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from scene_experts.core.errors import InputError
from scene_experts.core.types import Camera
from scene_experts.data.views import Capture
from scene_experts.geometry.rotation import common_up, matrix_to_quat, normalise_quats, quat_to_matrix

NAMES = ("auto", "orbit", "spiral", "views")
FREE = -1  # the id of a camera that is none of the capture's views: what belongs to a view (appearance codes) must not be taken
FACING = 0.7  # cameras whose directions have a mean longer than this look the same way: an orbit would go behind the scene
MOST_POSES = 40  # captured poses that a path goes through
LEVEL = math.cos(math.radians(15))  # of the roll of a picture that stands upright


@dataclass(frozen=True)
class CameraPath:
    """Cameras in order, `fps` of them a second."""

    cameras: tuple[Camera, ...]
    fps: float = 24.0

    def __len__(self) -> int:
        return len(self.cameras)


@dataclass(frozen=True)
class Around:
    """What the training cameras look at: the point nearest to all optical axes, their common up, and their frames."""

    centre: Tensor  # [3]
    up: Tensor  # [3] unit
    positions: Tensor  # [V, 3]
    rotations: Tensor  # [V, 3, 3] camera to world
    cameras: tuple[Camera, ...]

    @property
    def forward(self) -> Tensor:
        """Unit viewing directions [V, 3]."""
        return self.rotations[:, :, 2]


def around(capture: Capture) -> Around:
    """Looks at the training cameras of a capture (all its cameras where none is for training)."""
    cameras = tuple(capture.views[i].camera for i in (capture.train or capture.test))
    poses = torch.stack([c.world_to_cam.double() for c in cameras])
    rotations = poses[:, :3, :3].transpose(1, 2)
    positions = -(rotations @ poses[:, :3, 3:]).squeeze(2)
    up = common_up(rotations)
    forward = rotations[:, :, 2]
    # the point whose squared distances to all axes are least: sum (I - d d^T) (p - c) = 0; nearly parallel axes leave the depth open
    across = torch.eye(3, dtype=torch.float64) - forward[:, :, None] * forward[:, None, :]
    total = across.sum(0) / len(cameras)
    if torch.linalg.eigvalsh(total)[0] > 0.01:
        centre = torch.linalg.solve(total, (across @ positions[:, :, None]).squeeze(2).mean(0))
    else:
        centre = positions.mean(0) + normalised(forward.mean(0)) * depth(capture, positions.mean(0), normalised(forward.mean(0)))
    return Around(centre, up, positions, rotations, cameras)


def best_view(capture: Capture) -> int:
    """The view that shows a capture best at first sight, of the held-out ones (of those for training where none is held out).

    Upright (or else the one nearest to it: photographs on their side, views straight down), not nearer to what the cameras look at than
    half of the training cameras (or else the farthest), and of those the one that looks most level and most at the centre.
    """
    seen = around(capture)
    middle = float((seen.positions - seen.centre).norm(dim=1).median())
    chosen = capture.test or capture.train
    rotations = torch.stack([capture.views[i].camera.world_to_cam[:3, :3].double().T for i in chosen])
    to_centre = seen.centre - torch.stack([capture.views[i].camera.position.double() for i in chosen])
    distance = to_centre.norm(dim=1)
    ups, across = -rotations[:, :, 1] @ seen.up, rotations[:, :, 0] @ seen.up
    level = ups / (ups.square() + across.square()).sqrt().clamp_min(0.3)  # cosine of the roll; straight down there is hardly one
    fits = level >= min(LEVEL, float(level.max()))
    fits &= distance >= min(0.999 * middle, float(distance[fits].max()))
    score = (rotations[:, :, 2] * to_centre).sum(1) / distance.clamp_min(1e-12) * ups
    return chosen[int(score.masked_fill(~fits, -math.inf).argmax())]


def depth(capture: Capture, position: Tensor, direction: Tensor) -> float:
    """Median depth of the capture's points seen from a place; the extent where there are none in front."""
    if capture.points is None or not len(capture.points.xyz):
        return capture.extent
    along = (capture.points.xyz.double() - position) @ direction
    ahead = along[along > 0]
    return float(ahead.median()) if len(ahead) else capture.extent


def make(name: str, capture: Capture, frames: int, size: tuple[int, int] | None = None, fps: float = 24.0) -> CameraPath:
    """A path by name: orbit, spiral, views, or auto (orbit where the cameras stand around the scene, else spiral).

    size: width and height in px; by default the median of the training views. Raises InputError for another name or no frame.
    """
    if frames < 1:
        raise InputError(f"expected at least 1 frame, found {frames}; give more --seconds")
    seen = around(capture)
    if name == "auto":
        name = "spiral" if float(seen.forward.mean(0).norm()) > FACING else "orbit"
    if name not in NAMES:
        raise InputError(f"expected a path among {', '.join(NAMES)}, test or a file, found '{name}'; correct --path")
    poses = {"orbit": orbit, "spiral": spiral, "views": through}[name](seen, frames)
    model = lens(seen.cameras, size)
    return CameraPath(tuple(replace(model, world_to_cam=pose.float()) for pose in poses), fps)


def orbit(seen: Around, frames: int) -> list[Tensor]:
    """Once around the centre at the cameras' median height and distance, looking at it; world-to-camera matrices [4, 4]."""
    offset = seen.positions - seen.centre
    heights = offset @ seen.up
    flat = offset - heights[:, None] * seen.up
    radius, height = float(flat.norm(dim=1).median()), float(heights.median())
    first = normalised(flat[flat.norm(dim=1).argsort()[len(flat) // 2]])
    second = torch.linalg.cross(seen.up, first)
    out = []
    for i in range(frames):
        angle = 2 * math.pi * i / frames
        place = seen.centre + radius * (math.cos(angle) * first + math.sin(angle) * second) + height * seen.up
        out.append(look_at(place, seen.centre, seen.up))
    return out


def spiral(seen: Around, frames: int, turns: int = 2, reach: float = 0.5) -> list[Tensor]:
    """Circles in front of the scene within the cameras' own spread, looking at the centre: for captures that face one way."""
    middle = seen.positions.mean(0)
    forward = normalised(seen.centre - middle)
    right = normalised(torch.linalg.cross(forward, seen.up))
    up = torch.linalg.cross(right, forward)
    offset = seen.positions - middle
    spread = [float(torch.quantile((offset @ axis).abs(), 0.9)) for axis in (right, up, forward)]
    out = []
    for i in range(frames):
        angle = 2 * math.pi * turns * i / frames
        along = (math.cos(angle), math.sin(angle), math.sin(angle / turns))
        place = middle + sum(reach * s * a * axis for s, a, axis in zip(spread, along, (right, up, forward)))
        out.append(look_at(place, seen.centre, seen.up))
    return out


def through(seen: Around, frames: int) -> list[Tensor]:
    """Smoothly through the captured poses in the order of their names (at most MOST_POSES of them, evenly spread)."""
    count = min(len(seen.cameras), MOST_POSES)
    chosen = torch.linspace(0, len(seen.cameras) - 1, count).round().long()
    return interpolate(seen.positions[chosen], seen.rotations[chosen], frames)


def interpolate(positions: Tensor, rotations: Tensor, frames: int, times: Tensor | None = None, loop: bool = False) -> list[Tensor]:
    """World-to-camera matrices of `frames` poses along key poses.

    positions [P, 3]: camera centres, joined by a Catmull-Rom curve; rotations [P, 3, 3]: camera to world, joined on the sphere.
    times [P]: of the keys, ascending; evenly spaced by default. A loop comes back to the first.
    """
    quats = matrix_to_quat(rotations)
    if loop:
        positions, quats = torch.cat([positions, positions[:1]]), torch.cat([quats, quats[:1]])
        if times is not None:
            times = torch.cat([times, times[-1:] + (times[-1] - times[0]) / max(len(times) - 1, 1)])
    n = len(positions)
    times = torch.arange(n, dtype=torch.float64) if times is None else times.double()
    ends = torch.linspace(float(times[0]), float(times[-1]), frames + 1 if loop else max(frames, 1), dtype=torch.float64)[:frames]
    out = []
    for t in ends.tolist():
        i = min(max(int(torch.searchsorted(times, t, right=True)) - 1, 0), max(n - 2, 0))
        j = min(i + 1, n - 1)
        span = float(times[j] - times[i])
        u = (t - float(times[i])) / span if span > 0 else 0.0
        before = positions[n - 2 if loop and i == 0 else max(i - 1, 0)]
        after = positions[1 if loop and j == n - 1 else min(j + 1, n - 1)]
        out.append(pose(catmull_rom(before, positions[i], positions[j], after, u), quat_to_matrix(slerp(quats[i], quats[j], u))))
    return out


def catmull_rom(a: Tensor, b: Tensor, c: Tensor, d: Tensor, u: float) -> Tensor:
    """The point at `u` between b (0) and c (1) on the curve through a, b, c, d."""
    return 0.5 * (2 * b + (c - a) * u + (2 * a - 5 * b + 4 * c - d) * u**2 + (3 * b - a - 3 * c + d) * u**3)


def slerp(a: Tensor, b: Tensor, u: float) -> Tensor:
    """The rotation at `u` on the shorter way from unit quaternion a to b."""
    dot = float(a @ b)
    b, dot = (-b, -dot) if dot < 0 else (b, dot)
    if dot > 0.9995:  # too close to divide by the sine
        return normalise_quats(a + u * (b - a))
    angle = math.acos(min(dot, 1.0))
    return (math.sin((1 - u) * angle) * a + math.sin(u * angle) * b) / math.sin(angle)


def look_at(place: Tensor, target: Tensor, up: Tensor) -> Tensor:
    """World-to-camera matrix [4, 4] of a camera at `place` that looks at `target`; `up` points up in its picture."""
    forward = normalised(target - place)
    right = torch.linalg.cross(forward, up)
    if float(right.norm()) < 1e-6:  # looking straight up or down
        right = torch.linalg.cross(forward, torch.roll(up, 1))
    right = normalised(right)
    return pose(place, torch.stack([right, torch.linalg.cross(forward, right), forward], dim=1))


def pose(place: Tensor, rotation: Tensor) -> Tensor:
    """World-to-camera matrix of a camera centre and a camera-to-world rotation."""
    out = torch.eye(4, dtype=torch.float64)
    out[:3, :3] = rotation.T
    out[:3, 3] = -(rotation.T @ place)
    return out


def lens(cameras: Sequence[Camera], size: tuple[int, int] | None = None) -> Camera:
    """A camera of `size` px with the median vertical field of view of `cameras`, its principal point in the middle."""
    middle = sorted(cameras, key=lambda c: c.height / c.fy)[len(cameras) // 2]
    width, height = size or (middle.width, middle.height)
    return with_fov(middle, middle.fov, width, height)


def with_fov(camera: Camera, fov: float, width: int, height: int) -> Camera:
    """The camera with a vertical field of view (radians) and a size."""
    f = height / (2 * math.tan(fov / 2))
    K = torch.tensor([[f, 0.0, width / 2], [0.0, f, height / 2], [0.0, 0.0, 1.0]])
    return replace(camera, K=K, width=width, height=height, id=FREE)


def normalised(vector: Tensor) -> Tensor:
    return vector / vector.norm().clamp_min(1e-12)
