"""Reads and writes camera paths: this project's JSON (keyframes in the capture's own frame) and
nerfstudio's camera-path JSON."""

from __future__ import annotations

import logging
import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from scene_experts.core.errors import InputError
from scene_experts.core.io import read_json, write_json
from scene_experts.core.reading.budget import JSON
from scene_experts.core.reading.numbers import FARTHEST
from scene_experts.core.reading.source import guarding
from scene_experts.core.types import Camera
from scene_experts.data.transform import Similarity
from scene_experts.data.views import World
from scene_experts.geometry.poses import interpolate_poses, make_pose, with_fov
from scene_experts.view.paths import CameraPath

log: logging.Logger = logging.getLogger(__name__)
FORMAT = 1
FRAME, CAPTURE = "frame", "capture"  # entry of a path in nerfstudio's form that we wrote: its poses are in the capture's own frame
LARGEST, FASTEST = 16384, 1000  # px per side; frames per second
MOST_FRAMES, LONGEST = 36_000, 1e6  # of a path: 20 minutes at 30 frames per second; seconds
OPENGL = torch.diag(torch.tensor([1.0, -1.0, -1.0, 1.0], dtype=torch.float64))  # nerfstudio: y up, looking along -z


def write_path(path: Path, cameras: CameraPath, world: World, loop: bool = False, play_fps: float | None = None) -> None:
    """Write every camera as a keyframe in the capture's own frame, as `describe_path` has them."""
    write_json(path, describe_path(cameras, world, loop, play_fps))


def describe_path(cameras: CameraPath, world: World, loop: bool = False, play_fps: float | None = None) -> dict[str, Any]:
    """Return the cameras of a path as keyframes in the capture's own frame, as JSON values.

    They are {"format": 1, "fps", "loop", "width", "height", "keyframes": [{"time",
    "camera_to_world", "fov"}]} with times in seconds, 4x4 matrices with OpenCV axes and vertical
    fields of view in degrees.

    play_fps: Frames per second between the keyframes. None is `cameras.fps`, one frame per
    keyframe.
    """
    keys = [
        {"time": i / cameras.fps, "camera_to_world": to_input_frame(camera, world).tolist(), "fov": math.degrees(camera.fov)}
        for i, camera in enumerate(cameras.cameras)
    ]
    first = cameras.cameras[0]
    return {
        "format": FORMAT,
        "fps": play_fps or cameras.fps,
        "loop": loop,
        "width": first.width,
        "height": first.height,
        "keyframes": keys,
    }


def write_nerfstudio(path: Path, cameras: CameraPath, world: World) -> None:
    """Write nerfstudio's camera-path JSON: one entry per frame, with poses in the capture's own
    frame and OpenGL axes."""
    first = cameras.cameras[0]
    entries = [
        {
            "camera_to_world": (to_input_frame(camera, world) @ OPENGL).flatten().tolist(),
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
        FRAME: CAPTURE,
    }
    write_json(path, value)


def read_path(
    path: Path,
    world: World,
    model: Camera,
    size: tuple[int, int] | None = None,
    fps: float | None = None,
    moved: Similarity | None = None,
) -> CameraPath:
    """Read a camera path of either format and return it in the trained world. Poses between
    keyframes are interpolated.

    Args:
        world: The trained world of the capture.
        model: Camera whose near plane the path takes.
        size: Width and height in px, instead of those in the file.
        fps: Frames per second, instead of those in the file.
        moved: From the frame of nerfstudio's path to the capture's own. None: they are the same.

    Raises:
        InputError: if the file is damaged or of another format.
    """
    value = read_json(path, "camera path")
    theirs = isinstance(value, dict) and "camera_path" in value and value.get(FRAME) != CAPTURE
    if moved is not None and not theirs:
        raise InputError(f"expected a path of nerfstudio with --transform, found one in the capture's frame in {path}; leave it out")
    if theirs and moved is None:
        log.warning(
            "the poses in %s are taken as in the capture's own frame; nerfstudio's own are in the frame of its "
            "dataparser_transforms.json: give that with --transform",
            path,
        )
    with guarding(path, JSON, "camera path"):
        if isinstance(value, dict) and "camera_path" in value:
            return parse_nerfstudio(value, world, model, size, fps, moved or Similarity(torch.eye(3).double(), torch.zeros(3).double()))
        if isinstance(value, dict) and value.get("format") == FORMAT:
            return parse_keyframes(value, world, model, size, fps)
    raise InputError(
        f"expected a camera path of scene-experts or nerfstudio in {path}, found something else; see `scene-experts render --help`"
    )


def parse_keyframes(value: dict[str, Any], world: World, model: Camera, size: tuple[int, int] | None, fps: float | None) -> CameraPath:
    """Return the path in this project's JSON. Raises ValueError for values out of range."""
    keys = value["keyframes"]
    if not keys:
        raise ValueError("no keyframes")
    check_count(len(keys))
    width, height = size or check_size(value["width"], value["height"])
    rate, loop = check_rate(fps or value["fps"]), bool(value.get("loop", False))
    times = torch.tensor([float(k["time"]) for k in keys], dtype=torch.float64)
    if len(keys) > 1 and not bool((times.diff() > 0).all()):
        raise ValueError("a time that does not increase from one keyframe to the next")
    poses = torch.stack([check_pose(torch.tensor(k["camera_to_world"], dtype=torch.float64)) for k in keys])
    if float(times.abs().max()) > LONGEST:
        raise ValueError(f"a time that is not within {LONGEST:g} s")
    span = float(times[-1] - times[0])
    if loop and len(keys) > 1:
        span += span / (len(keys) - 1)
    frames = check_count(max(1, round(span * rate) + (0 if loop else 1)))
    found = interpolate_poses(world.from_input(poses[:, :3, 3]), poses[:, :3, :3], frames, times, loop)
    degrees = torch.tensor([float(k["fov"]) for k in keys], dtype=torch.float64)
    if loop:  # the way back to the first keyframe
        times, degrees = torch.cat([times, times[:1] + span]), torch.cat([degrees, degrees[:1]])
    out = []
    for i, pose in enumerate(found):
        t = float(times[0]) + i / rate
        out.append(make_camera(model, pose, math.radians(interpolate(times, degrees, t)), width, height))
    return CameraPath(tuple(out), rate)


def parse_nerfstudio(
    value: dict[str, Any], world: World, model: Camera, size: tuple[int, int] | None, fps: float | None, moved: Similarity
) -> CameraPath:
    """Return the path in nerfstudio's JSON. moved: from its frame to the capture's own.

    Raises ValueError for values out of range and for cameras without perspective.
    """
    if value.get("camera_type", "perspective") != "perspective":
        raise ValueError(f"the camera_type {value['camera_type']}, but only perspective is supported")
    width, height = size or check_size(value["render_width"], value["render_height"])
    out = []
    check_count(len(value["camera_path"]))
    for entry in value["camera_path"]:
        pose = check_pose(torch.tensor(entry["camera_to_world"], dtype=torch.float64).reshape(4, 4) @ OPENGL)
        place = moved.scale * (moved.rotation @ pose[:3, 3]) + moved.shift
        to_cam = make_pose(world.from_input(place), moved.rotation @ pose[:3, :3])
        out.append(make_camera(model, to_cam, math.radians(float(entry["fov"])), width, height))
    if not out:
        raise ValueError("an empty camera_path")
    return CameraPath(tuple(out), check_rate(fps or value.get("fps", 24)))


def check_count(frames: int) -> int:
    """Return a number of frames. Raises ValueError if it is out of range."""
    if frames > MOST_FRAMES:
        raise ValueError(f"{frames:,} frames, more than {MOST_FRAMES:,}")
    return frames


def check_size(width: Any, height: Any) -> tuple[int, int]:
    """Return width and height in px as integers. Raises ValueError if they are out of range."""
    width, height = int(width), int(height)
    if not (1 <= width <= LARGEST and 1 <= height <= LARGEST):
        raise ValueError(f"a size of {width} x {height} px, which is not between 1 and {LARGEST}")
    return width, height


def check_rate(value: Any) -> float:
    """Return frames per second as a float. Raises ValueError if they are out of range."""
    rate = float(value)
    if not 0 < rate <= FASTEST:
        raise ValueError(f"fps of {rate:g}, which is not above 0 and at most {FASTEST}")
    return rate


def make_camera(model: Camera, to_cam: Tensor, fov: float, width: int, height: int) -> Camera:
    """Return a camera with the pose `to_cam` and a vertical field of view in radians. Raises
    ValueError if that is out of range."""
    if not 0 < fov < math.pi:
        raise ValueError(f"a fov of {math.degrees(fov):.3g} degrees, which is not between 0 and 180")
    return replace(with_fov(model, fov, width, height), world_to_cam=to_cam.float())


def check_pose(pose: Tensor) -> Tensor:
    """Return `pose`. Raises ValueError unless it is a finite 4x4 matrix with a rotation."""
    if pose.shape != (4, 4) or not bool((pose.abs() <= FARTHEST).all()):  # False for NaN
        raise ValueError("a camera_to_world that is not a 4x4 matrix of finite numbers")
    rotation = pose[:3, :3]
    if not torch.allclose(rotation @ rotation.T, torch.eye(3, dtype=pose.dtype), atol=1e-3) or float(torch.linalg.det(rotation)) < 0:
        raise ValueError("a camera_to_world whose 3x3 part is not a rotation")
    return pose


def to_input_frame(camera: Camera, world: World) -> Tensor:
    """Return the camera-to-world matrix [4, 4] float64 of a camera in the capture's own frame."""
    pose = camera.world_to_cam.double()
    out = torch.eye(4, dtype=torch.float64)
    out[:3, :3] = pose[:3, :3].T
    out[:3, 3] = world.to_input(-(pose[:3, :3].T @ pose[:3, 3]))
    return out


def interpolate(x: Tensor, y: Tensor, t: float) -> float:
    """Interpolate samples (x ascending) linearly at t. The value is constant beyond the ends."""
    if len(x) == 1 or t <= float(x[0]):
        return float(y[0])
    if t >= float(x[-1]):
        return float(y[-1])
    i = int(torch.searchsorted(x, t, right=True)) - 1
    u = (t - float(x[i])) / float(x[i + 1] - x[i])
    return float(y[i]) * (1 - u) + float(y[i + 1]) * u


def is_path_file(text: str) -> bool:
    """Return whether the value of `--path` names a file rather than a kind of path."""
    return text.endswith(".json") or Path(text).is_file()
