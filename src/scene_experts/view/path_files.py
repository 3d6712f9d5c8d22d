"""Camera paths as files: our own JSON (keyframes in the capture's frame) and nerfstudio's camera-path JSON, both ways."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from scene_experts.core.errors import InputError
from scene_experts.core.io import read_json, write_json
from scene_experts.core.types import Camera
from scene_experts.data.views import World
from scene_experts.view.paths import CameraPath, interpolate, with_fov

FORMAT = 1
LARGEST, FASTEST = 16384, 1000  # px of a side; frames a second
OPENGL = torch.diag(torch.tensor([1.0, -1.0, -1.0, 1.0], dtype=torch.float64))  # nerfstudio: y up, looking along -z


def write(path: Path, cameras: CameraPath, world: World, loop: bool = False, play_fps: float | None = None) -> None:
    """Write every camera as a keyframe, in the capture's own frame.

    {"format": 1, "fps", "loop", "width", "height", "keyframes": [{"time", "camera_to_world" 4x4 (OpenCV axes), "fov" degrees, vertical}]}
    play_fps: frames a second to draw between keyframes that are further apart.
    """
    keys = [
        {"time": i / cameras.fps, "camera_to_world": to_world(camera, world).tolist(), "fov": math.degrees(camera.fov)}
        for i, camera in enumerate(cameras.cameras)
    ]
    first = cameras.cameras[0]
    value = {
        "format": FORMAT,
        "fps": play_fps or cameras.fps,
        "loop": loop,
        "width": first.width,
        "height": first.height,
        "keyframes": keys,
    }
    write_json(path, value)


def write_nerfstudio(path: Path, cameras: CameraPath, world: World) -> None:
    """Write nerfstudio's camera-path JSON: one entry a frame, poses in the capture's own frame with OpenGL axes."""
    first = cameras.cameras[0]
    entries = [
        {
            "camera_to_world": (to_world(camera, world) @ OPENGL).flatten().tolist(),
            "fov": math.degrees(camera.fov),
            "aspect": camera.width / camera.height,
        }
        for camera in cameras.cameras
    ]
    value = {
        "camera_type": "perspective",
        "render_height": first.height,
        "render_width": first.width,
        "camera_path": entries,
        "keyframes": [],
        "fps": cameras.fps,
        "seconds": len(cameras) / cameras.fps,
        "smoothness_value": 0.0,
        "is_cycle": False,
        "crop": None,
    }
    write_json(path, value)


def read(path: Path, world: World, model: Camera, size: tuple[int, int] | None = None, fps: float | None = None) -> CameraPath:
    """The path in a file of either kind, in the trained world. Between keyframes of ours the camera moves smoothly.

    model: the camera whose near plane it takes; size and fps: in place of the file's own. Raises InputError where the file is neither.
    """
    value = read_json(path, "camera path")
    try:
        if isinstance(value, dict) and "camera_path" in value:
            return from_nerfstudio(value, world, model, size, fps)
        if isinstance(value, dict) and value.get("format") == FORMAT:
            return from_keyframes(value, world, model, size, fps)
    except (KeyError, TypeError, ValueError, RuntimeError, IndexError, OverflowError) as error:
        raise InputError(f"expected a whole camera path in {path}, found {error}; write it again") from error
    raise InputError(f"expected a camera path of ours or of nerfstudio in {path}, found something else; see `scene-experts render --help`")


def from_keyframes(value: dict[str, Any], world: World, model: Camera, size: tuple[int, int] | None, fps: float | None) -> CameraPath:
    keys = value["keyframes"]
    if not keys:
        raise ValueError("keyframes: there are none")
    width, height = size or size_in(value["width"], value["height"])
    rate, loop = rate_in(fps or value["fps"]), bool(value.get("loop", False))
    times = torch.tensor([float(k["time"]) for k in keys], dtype=torch.float64)
    if len(keys) > 1 and not bool((times.diff() > 0).all()):
        raise ValueError("time: it must rise from one keyframe to the next")
    poses = torch.stack([proper(torch.tensor(k["camera_to_world"], dtype=torch.float64)) for k in keys])
    span = float(times[-1] - times[0])
    if loop and len(keys) > 1:
        span += span / (len(keys) - 1)
    frames = max(1, round(span * rate) + (0 if loop else 1))
    positions = world.from_input(poses[:, :3, 3])
    found = interpolate(positions, poses[:, :3, :3], frames, times, loop)
    degrees = torch.tensor([float(k["fov"]) for k in keys], dtype=torch.float64)
    if loop:  # the way back to the first
        times, degrees = torch.cat([times, times[:1] + span]), torch.cat([degrees, degrees[:1]])
    out = []
    for i, pose in enumerate(found):
        t = float(times[0]) + i / rate
        angle = math.radians(float(linear(times, degrees, t)))
        out.append(camera_of(model, pose, angle, width, height))
    return CameraPath(tuple(out), rate)


def from_nerfstudio(value: dict[str, Any], world: World, model: Camera, size: tuple[int, int] | None, fps: float | None) -> CameraPath:
    if value.get("camera_type", "perspective") != "perspective":
        raise ValueError(f"camera_type: {value['camera_type']} is not drawn here, only perspective")
    width, height = size or size_in(value["render_width"], value["render_height"])
    out = []
    for entry in value["camera_path"]:
        pose = proper(torch.tensor(entry["camera_to_world"], dtype=torch.float64).reshape(4, 4) @ OPENGL)
        rotation, place = pose[:3, :3], world.from_input(pose[:3, 3])
        to_cam = torch.eye(4, dtype=torch.float64)
        to_cam[:3, :3], to_cam[:3, 3] = rotation.T, -(rotation.T @ place)
        out.append(camera_of(model, to_cam, math.radians(float(entry["fov"])), width, height))
    if not out:
        raise ValueError("camera_path: it is empty")
    return CameraPath(tuple(out), rate_in(fps or value.get("fps", 24)))


def size_in(width: Any, height: Any) -> tuple[int, int]:
    """A picture's size in px as a file has it. Raises ValueError for one that cannot be drawn."""
    width, height = int(width), int(height)
    if not (1 <= width <= LARGEST and 1 <= height <= LARGEST):
        raise ValueError(f"width and height: {width} x {height} px is no size between 1 and {LARGEST}")
    return width, height


def rate_in(value: Any) -> float:
    """Frames a second as a file has them. Raises ValueError for none."""
    rate = float(value)
    if not 0 < rate <= FASTEST:
        raise ValueError(f"fps: {rate:g} is no number above 0 and up to {FASTEST}")
    return rate


def camera_of(model: Camera, to_cam: Tensor, angle: float, width: int, height: int) -> Camera:
    if not 0 < angle < math.pi:
        raise ValueError(f"fov: {math.degrees(angle):.3g} degrees is no field of view")
    camera = with_fov(model, angle, width, height)
    return replace(camera, world_to_cam=to_cam.float())


def proper(pose: Tensor) -> Tensor:
    """The pose, if it is a rotation and a place, all finite."""
    if pose.shape != (4, 4) or not bool(pose.isfinite().all()):
        raise ValueError("camera_to_world: not a 4 x 4 matrix of finite numbers")
    rotation = pose[:3, :3]
    if not torch.allclose(rotation @ rotation.T, torch.eye(3, dtype=pose.dtype), atol=1e-3) or float(torch.linalg.det(rotation)) < 0:
        raise ValueError("camera_to_world: its 3 x 3 part is no rotation")
    return pose


def to_world(camera: Camera, world: World) -> Tensor:
    """Camera-to-world matrix [4, 4] in the capture's own frame."""
    pose = camera.world_to_cam.double()
    out = torch.eye(4, dtype=torch.float64)
    out[:3, :3] = pose[:3, :3].T
    out[:3, 3] = world.to_input(-(pose[:3, :3].T @ pose[:3, 3]))
    return out


def linear(x: Tensor, y: Tensor, t: float) -> float:
    """y at t between samples (x ascending), held constant beyond the ends."""
    if len(x) == 1 or t <= float(x[0]):
        return float(y[0])
    if t >= float(x[-1]):
        return float(y[-1])
    i = int(torch.searchsorted(x, t, right=True)) - 1
    u = (t - float(x[i])) / float(x[i + 1] - x[i])
    return float(y[i]) * (1 - u) + float(y[i + 1]) * u


def is_path_file(text: str) -> bool:
    """Whether `--path` names a file rather than a kind of path."""
    return text.endswith(".json") or Path(text).is_file()
