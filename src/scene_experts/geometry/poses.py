"""Camera poses: construction, interpolation, and cameras that belong to no view of a capture.
OpenCV axes, float64."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from scene_experts.core.types import Camera
from scene_experts.geometry.rotation import matrix_to_quat, normalise_quats, quat_to_matrix

FREE = -1  # the id of a camera that is not a view of the capture, so nothing that belongs to a view (appearance codes) applies to it


def normalise(vector: Tensor) -> Tensor:
    """Scale a vector to unit length. The zero vector stays zero."""
    return vector / vector.norm().clamp_min(1e-12)


def make_pose(position: Tensor, rotation: Tensor) -> Tensor:
    """Return the world-to-camera matrix [4, 4] of a camera centre [3] and a camera-to-world
    rotation [3, 3]."""
    out = torch.eye(4, dtype=torch.float64)
    out[:3, :3] = rotation.T
    out[:3, 3] = -(rotation.T @ position)
    return out


def exp_motion(motion: Tensor) -> Tensor:
    """Return the rigid motion [4, 4] of a twist [6]: rotation vector (rad), then translation. With a
    graph if the twist has one."""
    x, y, z, *move = motion.unbind()
    o = torch.zeros_like(x)
    twist = torch.stack([o, -z, y, move[0], z, o, -x, move[1], -y, x, o, move[2], o, o, o, o]).view(4, 4)
    return torch.linalg.matrix_exp(twist)


def log_motion(pose: Tensor) -> Tensor:
    """Return the twist [6] float64 of a rigid motion [4, 4] that turns by less than pi: the inverse of
    `exp_motion`."""
    from scipy.linalg import logm  # takes long to import, and most commands do not need it

    twist = torch.from_numpy(np.real(np.asarray(logm(pose.double().cpu().numpy()))).copy())
    return torch.cat([torch.stack([twist[2, 1], twist[0, 2], twist[1, 0]]), twist[:3, 3]])


def look_at(position: Tensor, target: Tensor, up: Tensor) -> Tensor:
    """Return the world-to-camera matrix [4, 4] of a camera at `position` that looks at `target`,
    with `up` upwards in its image."""
    forward = normalise(target - position)
    right = torch.linalg.cross(forward, up)
    if float(right.norm()) < 1e-6:  # looking straight up or down
        right = torch.linalg.cross(forward, torch.roll(up, 1))
    right = normalise(right)
    return make_pose(position, torch.stack([right, torch.linalg.cross(forward, right), forward], dim=1))


def interpolate_poses(positions: Tensor, rotations: Tensor, frames: int, times: Tensor | None = None, loop: bool = False) -> list[Tensor]:
    """Return the world-to-camera matrices [4, 4] of `frames` poses along key poses.

    Positions follow a Catmull-Rom curve, rotations a spherical linear interpolation.

    Args:
        positions: Camera centres [P, 3] of the key poses.
        rotations: Camera-to-world rotations [P, 3, 3] of the key poses.
        times: Ascending times [P] of the key poses. None spaces them evenly.
        loop: Return to the first key pose, which is not repeated at the end.
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
        position = catmull_rom(before, positions[i], positions[j], after, u)
        out.append(make_pose(position, quat_to_matrix(slerp(quats[i], quats[j], u))))
    return out


def catmull_rom(a: Tensor, b: Tensor, c: Tensor, d: Tensor, u: float) -> Tensor:
    """Return the point at `u` in [0, 1] between b and c on the Catmull-Rom curve through a, b, c
    and d."""
    return 0.5 * (2 * b + (c - a) * u + (2 * a - 5 * b + 4 * c - d) * u**2 + (3 * b - a - 3 * c + d) * u**3)


def slerp(a: Tensor, b: Tensor, u: float) -> Tensor:
    """Interpolate unit quaternions [4] from a (u = 0) to b (u = 1) along the shorter arc."""
    dot = float(a @ b)
    b, dot = (-b, -dot) if dot < 0 else (b, dot)
    if dot > 0.9995:  # too close to divide by the sine
        return normalise_quats(a + u * (b - a))
    angle = math.acos(min(dot, 1.0))
    return (math.sin((1 - u) * angle) * a + math.sin(u * angle) * b) / math.sin(angle)


def with_fov(camera: Camera, fov: float, width: int, height: int) -> Camera:
    """Return a free camera at the same pose with a vertical field of view in radians, a size in px
    and a centred principal point."""
    f = height / (2 * math.tan(fov / 2))
    K = torch.tensor([[f, 0.0, width / 2], [0.0, f, height / 2], [0.0, 0.0, 1.0]])
    return replace(camera, K=K, width=width, height=height, id=FREE)
