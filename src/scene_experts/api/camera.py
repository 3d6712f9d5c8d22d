"""`Camera`: the pose and the lens of a picture."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

from scene_experts.api import checked
from scene_experts.core.errors import InputError

if TYPE_CHECKING:
    from scene_experts.core import types
    from scene_experts.data.views import World

LARGEST = 16384  # px of a side


@dataclass(frozen=True, eq=False)
class Camera:
    """A pinhole camera in the capture's own frame and unit: the frame of its COLMAP or
    transforms.json poses.

    Axes are OpenCV's: x right, y down, z forward. The centre of pixel (column i, row j) is at (i +
    0.5, j + 0.5) px. The arrays are read-only.

    Raises:
        InputError: The pose is no rotation and translation, the focal length is not above 0, or a
            side is not within 1 to 16384 px.
    """

    world_to_camera: NDArray[np.float64]
    """[4, 4] Rotation and translation from the world to the camera."""
    K: NDArray[np.float64]
    """[3, 3] Intrinsics, px: [[fx, 0, cx], [0, fy, cy], [0, 0, 1]]."""
    width: int
    """Width of the picture, px, 1 to 16384."""
    height: int
    """Height of the picture, px, 1 to 16384."""
    near: float | None = None
    """Near plane: nothing closer along z is drawn, capture's unit. None uses the near plane of the
    run."""
    view: int = -1
    """Index of the view whose photograph this camera took; -1 for any other camera. Appearance
    codes depend on it."""

    def __post_init__(self) -> None:
        pose, K = matrix(self.world_to_camera, 4, "world_to_camera"), matrix(self.K, 3, "K")
        rotation = pose[:3, :3]
        if not np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-3) or np.linalg.det(rotation) < 0 or pose[3].tolist() != [0, 0, 0, 1]:
            raise InputError(
                "expected world_to_camera as a rotation and a translation, found another matrix; give OpenCV axes without scale"
            )
        if not (K[0, 0] > 0 and K[1, 1] > 0) or K[0, 1] != 0 or K[1, 0] != 0 or K[2].tolist() != [0, 0, 1]:
            raise InputError(f"expected K as [[fx, 0, cx], [0, fy, cy], [0, 0, 1]] with fx, fy above 0, found {K.tolist()}; correct it")
        width, height = checked.side("width", self.width), checked.side("height", self.height)
        if max(width, height) > LARGEST:
            raise InputError(f"expected a width and height from 1 to {LARGEST} px, found {width} x {height}; choose a smaller size")
        view = checked.integer("view", self.view, -1)
        if self.near is not None and not checked.real("near", self.near) > 0:
            raise InputError(f"expected near as a length above 0, found {self.near}; leave it out for the run's own")
        for name, value in (("world_to_camera", pose), ("K", K), ("width", width), ("height", height), ("view", view)):
            object.__setattr__(self, name, value)

    @classmethod
    def look_at(
        cls,
        eye: ArrayLike,
        target: ArrayLike,
        up: ArrayLike = (0.0, 0.0, 1.0),
        *,
        width: int,
        height: int,
        fov: float = 50.0,
        near: float | None = None,
    ) -> Camera:
        """Return a camera that looks at a point. `Capture.look_at` uses the lens and upward
        direction of a capture instead.

        Args:
            eye: [3] Centre of the camera.
            target: [3] Point in the middle of the picture.
            up: [3] Direction that points upwards in the picture. If it is parallel to the line of
                sight, the coordinate axis that is most perpendicular to the line of sight replaces
                it.
            width: Width of the picture, px.
            height: Height of the picture, px.
            fov: Vertical field of view, degrees, between 0 and 180.
            near: Near plane, capture's unit. Default: that of the run.

        Raises:
            InputError: `eye` and `target` are the same point, or a value is out of range.
        """
        place, forward, upward = vector(eye, "eye"), vector(target, "target") - vector(eye, "eye"), vector(up, "up")
        if not np.linalg.norm(forward) > 0:
            raise InputError(f"expected a target away from the eye, found both at {place.tolist()}; move one of them")
        forward = forward / np.linalg.norm(forward)
        right = np.cross(forward, upward)
        if not np.linalg.norm(right) > 1e-6 * np.linalg.norm(upward):  # parallel to the line of sight
            right = np.cross(forward, np.eye(3)[np.abs(forward).argmin()])
        right = right / np.linalg.norm(right)
        rotation = np.stack([right, np.cross(forward, right), forward])
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = rotation, -rotation @ place
        return cls(pose, lens(fov, width, height), width, height, near)

    @classmethod
    def from_pose(
        cls,
        camera_to_world: ArrayLike,
        *,
        width: int,
        height: int,
        fx: float,
        fy: float | None = None,
        cx: float | None = None,
        cy: float | None = None,
        near: float | None = None,
    ) -> Camera:
        """Return a camera from its pose and intrinsics.

        Args:
            camera_to_world: [4, 4] or [3, 4] Rotation and translation, OpenCV axes. A rounded
                rotation becomes the nearest exact one, so `position` is the given centre.
            width: Width of the picture, px.
            height: Height of the picture, px.
            fx: Horizontal focal length, px, above 0.
            fy: Vertical focal length, px, above 0. Default: fx.
            cx: Column of the principal point, px. Default: the middle of the picture.
            cy: Row of the principal point, px. Default: the middle of the picture.
            near: Near plane, capture's unit. Default: that of the run.

        Raises:
            InputError: The pose is no rotation and translation, or a value is out of range.
        """
        given = np.array(camera_to_world, dtype=np.float64) if is_numbers(camera_to_world) else np.zeros(0)
        pose = matrix(np.vstack([given, [0, 0, 0, 1]]) if given.shape == (3, 4) else given, 4, "camera_to_world")
        width, height = checked.side("width", width), checked.side("height", height)
        K = [[fx, 0, width / 2 if cx is None else cx], [0, fx if fy is None else fy, height / 2 if cy is None else cy], [0, 0, 1]]
        rotation, back = pose[:3, :3], np.eye(4)
        u, scales, v = np.linalg.svd(rotation)
        if np.abs(scales - 1).max() <= 5e-4:  # anything else is refused below
            rotation = u @ v
        back[:3, :3], back[:3, 3] = rotation.T, -rotation.T @ pose[:3, 3]
        return cls(back, np.array(K, dtype=np.float64), width, height, near)

    @property
    def camera_to_world(self) -> NDArray[np.float64]:
        """[4, 4] Rotation and translation from the camera to the world."""
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = self.world_to_camera[:3, :3].T, self.position
        return pose

    @property
    def position(self) -> NDArray[np.float64]:
        """[3] Centre of the camera in the world, capture's unit."""
        return -self.world_to_camera[:3, :3].T @ self.world_to_camera[:3, 3]

    @property
    def fov(self) -> float:
        """Vertical field of view, degrees, if the principal point is in the middle of the
        picture."""
        return math.degrees(2 * math.atan(self.height / (2 * self.K[1, 1])))

    def resized(self, width: int, height: int) -> Camera:
        """Return the camera with a picture of another size, px. Another aspect ratio stretches the
        picture."""
        width, height = checked.side("width", width), checked.side("height", height)
        factor = np.array([[width / self.width], [height / self.height], [1.0]])
        return replace(self, K=self.K * factor, width=width, height=height)

    def __repr__(self) -> str:
        view = f", view={self.view}" if self.view >= 0 else ""
        return f"Camera({self.width}x{self.height}, position={np.round(self.position, 3).tolist()}, fov={self.fov:.1f}{view})"


def lens(fov: float, width: int, height: int) -> NDArray[np.float64]:
    """K [3, 3] of a vertical field of view in degrees, with the principal point in the middle.
    Raises InputError for no field of view."""
    width, height = checked.side("width", width), checked.side("height", height)
    if not 0 < checked.real("fov", fov) < 180:
        raise InputError(f"expected fov between 0 and 180 degrees, found {fov}; correct it")
    focal = height / (2 * math.tan(math.radians(fov) / 2))
    return np.array([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]])


def is_numbers(value: ArrayLike) -> bool:
    try:
        return bool(np.isfinite(np.asarray(value, dtype=np.float64)).all())
    except (TypeError, ValueError):
        return False


def matrix(value: ArrayLike, side: int, name: str) -> NDArray[np.float64]:
    """A read-only copy of a [side, side] matrix of finite numbers. Raises InputError for anything
    else."""
    if not is_numbers(value) or np.shape(value) != (side, side):
        raise InputError(f"expected {name} as a {side} x {side} matrix of finite numbers, found {describe(value)}; correct it")
    out = np.array(value, dtype=np.float64)
    out.flags.writeable = False
    return out


def vector(value: ArrayLike, name: str) -> NDArray[np.float64]:
    """Three finite numbers. Raises InputError for anything else."""
    if not is_numbers(value) or np.shape(value) != (3,):
        raise InputError(f"expected {name} as three finite numbers, found {describe(value)}; correct it")
    return np.array(value, dtype=np.float64)


def describe(value: ArrayLike) -> str:
    return f"an array of shape {np.shape(value)}" if hasattr(value, "shape") else " ".join(repr(value).split())[:60]


def to_trained(camera: Camera, world: World, near: float) -> types.Camera:
    """The camera in the trained world, float32. near: the run's near plane, trained units, for a
    camera without its own."""
    import torch

    from scene_experts.core import types

    pose, K = (torch.tensor(value, dtype=torch.float64) for value in (camera.world_to_camera, camera.K))
    own = types.Camera(pose, K, camera.width, camera.height, 1.0 if camera.near is None else camera.near, camera.view)
    moved = world.camera_from_input(own).to(dtype=torch.float32)
    return replace(moved, near=near) if camera.near is None else moved


def from_trained(camera: types.Camera, world: World) -> Camera:
    """The camera in the capture's own frame. Its near plane is left to the run."""
    import torch

    moved = world.camera_to_input(camera.to(dtype=torch.float64))
    return Camera(moved.world_to_cam.numpy(), moved.K.numpy(), camera.width, camera.height, None, camera.id)
