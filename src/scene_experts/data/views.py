"""A loaded capture: its views, points and split, and the world that it is trained in."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field, replace
from pathlib import Path

import torch
from torch import Tensor

from scene_experts.core.errors import InputError
from scene_experts.core.types import Camera, Points
from scene_experts.data.depth_maps import DepthFile
from scene_experts.data.depth_views import read_map
from scene_experts.data.store import ImageStore

Vector = tuple[float, float, float]
_FLOAT32 = 2.0**-23  # step of float32, relative
FINEST = 1e-5  # step of float32 that positions may have, relative to the extent
SAMPLED = 4  # views whose poses identify those of a capture


def typical_size(sizes: Iterable[tuple[int, int]]) -> tuple[int, int]:
    """Return the width and height of median area, px: what most photographs of a mixed capture cost."""
    ordered = sorted(sizes, key=lambda size: size[0] * size[1])
    return ordered[len(ordered) // 2]


@dataclass(frozen=True)
class View:
    """One photograph: its name in the capture, its camera and its file.

    The camera is in the trained world and at the trained resolution.
    """

    name: str  # relative path with extension, unique in the capture
    camera: Camera
    path: Path
    depth: DepthFile | None = None  # its depth map


@dataclass(frozen=True)
class Frame:
    """The pixels of a view."""

    rgb: Tensor  # [H, W, 3] uint8
    mask: Tensor | None  # [H, W] float32 in [0, 1]; 1 = the pixel counts; None = every pixel counts


@dataclass(frozen=True)
class World:
    """The coordinate frame that a capture is trained in.

    A point is mapped by `trained = (input + shift) * scale`, where `input` is the capture's own
    frame. Axes are not rotated.
    """

    scale: float = 1.0
    shift: Vector = (0.0, 0.0, 0.0)

    @property
    def identity(self) -> bool:
        """Whether the trained world is the capture's own frame."""
        return self.scale == 1.0 and self.shift == (0.0, 0.0, 0.0)

    def from_input(self, xyz: Tensor) -> Tensor:
        """Map points [..., 3] from the capture's own frame to the trained world."""
        return (xyz + torch.tensor(self.shift, dtype=xyz.dtype, device=xyz.device)) * self.scale

    def to_input(self, xyz: Tensor) -> Tensor:
        """Map points [..., 3] from the trained world to the capture's own frame."""
        return xyz / self.scale - torch.tensor(self.shift, dtype=xyz.dtype, device=xyz.device)

    def camera_from_input(self, camera: Camera) -> Camera:
        """Map a camera from the capture's own frame to the trained world. The near plane is a
        length and is scaled too."""
        pose = camera.world_to_cam.double()
        shift = torch.tensor(self.shift, dtype=torch.float64, device=pose.device)
        t = (pose[:3, 3] - pose[:3, :3] @ shift) * self.scale  # x_cam = R (X / scale - shift) + t, then lengths times scale
        return _with_translation(camera, t, self.scale)

    def camera_to_input(self, camera: Camera) -> Camera:
        """Map a camera from the trained world to the capture's own frame, the inverse of
        `camera_from_input`."""
        pose = camera.world_to_cam.double()
        shift = torch.tensor(self.shift, dtype=torch.float64, device=pose.device)
        return _with_translation(camera, pose[:3, 3] / self.scale + pose[:3, :3] @ shift, 1 / self.scale)

    def local_origin(self, extent: float) -> Vector:
        """Return a place of whole numbers in the capture's own frame, near the trained world, from
        which float32 holds positions; 0 where it holds them as they are.

        A file whose positions are float32 is written relative to it. extent: Of the cameras,
        trained units.
        """
        centre = tuple(-value for value in self.shift)
        if max(map(abs, centre)) * _FLOAT32 <= FINEST * extent / self.scale:
            return 0.0, 0.0, 0.0
        x, y, z = (float(round(value)) for value in centre)
        return x, y, z

    def seen_from(self, origin: Vector) -> World:
        """Return this world for points relative to `origin`, a place in the capture's own frame."""
        x, y, z = (a + b for a, b in zip(self.shift, origin))
        return World(self.scale, (x, y, z))

    def then(self, shift: Vector, scale: float) -> World:
        """Return this world followed by another transform, `(trained + shift) * scale`."""
        x, y, z = (a + b / self.scale for a, b in zip(self.shift, shift))
        return World(self.scale * scale, (x, y, z))


def _with_translation(camera: Camera, t: Tensor, scale: float) -> Camera:
    pose = camera.world_to_cam.double().clone()
    pose[:3, 3] = t
    return replace(camera, world_to_cam=pose.to(camera.world_to_cam.dtype), near=camera.near * scale)


@dataclass(frozen=True)
class Capture:
    """Photographs with camera poses, ready for training, and the choices that were made while
    loading them."""

    name: str
    root: Path
    kind: str  # name of the reader that read it, e.g. "colmap"
    views: tuple[View, ...]  # sorted by name; views[i].camera.id == i
    points: Points | None
    train: tuple[int, ...]  # indices of the training views
    test: tuple[int, ...]  # indices of the held-out views
    images: ImageStore  # frame i belongs to view i
    world: World
    extent: float  # R = 1.1 times the largest distance of a training camera from their mean (as 3DGS), trained units
    resolution: str  # "as-is", "cap1600", "factor:2", "longest:800", "inria:4"
    split: str  # "mod8", "first:31", "none", "files"
    background: Vector  # RGB in [0, 1] behind the scene
    warnings: tuple[str, ...] = field(default=())
    states_split: bool = False  # the files divide the views into training and test views, even if no test view is left
    bounds: tuple[Vector, Vector] | None = None  # lower and upper corner of the scene in the capture's own frame; None: unknown

    applied: object = None  # rows of the 3x4 matrix that turned a reconstruction into the capture's own frame, unchecked
    applied_scale: object = None  # factor from the reconstruction's unit to the capture's own, unchecked; None: 1
    random_points: bool = False  # its points are random
    model: Path | None = None  # folder of the reconstruction that was read, if it is COLMAP's
    omitted: tuple[str, ...] = ()  # names of the photographs that --leave-out leaves out; they have no views
    posed: str = ""  # `poses` before `with_cameras`
    left_out: tuple[int, ...] = ()  # indices of training views that --views leaves out; they still identify the capture

    @property
    def alpha_over(self) -> Vector | None:
        """RGB in [0, 1] that transparent pixels of the photographs are composited over; None: alpha
        is a mask."""
        return next((source.background for source in self.images.sources), None)

    def frame(self, index: int) -> Frame:
        """Return the pixels of view `index`. Raises InputError if its file cannot be read."""
        rgb, mask = self.images.get(index)
        return Frame(rgb, None if mask is None else mask.float() / 255)

    def depth(self, index: int) -> Tensor | None:
        """Return the depth map [h, w] of view `index` in trained units, 0 where it is not known;
        None if the view has none. It shows what the view shows, at 512 pixels or less.

        Raises InputError if its file cannot be read.
        """
        file = self.views[index].depth
        return None if file is None else read_map(file, self.images.sources[index]).mul_(self.world.scale)

    def fingerprint(self) -> str:
        """Return a short hash of the names and sizes of the views and of the split.

        A run compares it to recognise its capture, wherever the capture's folder is.
        """
        train = sorted(self.train + self.left_out) if self.left_out else self.train
        content = [[(v.name, v.camera.width, v.camera.height) for v in self.views], train, self.test]
        return hashlib.sha256(json.dumps(content).encode()).hexdigest()[:16]

    def photographs(self) -> str:
        """Return a short hash of the names and sizes in bytes of the photographs and their masks: of
        files that were replaced, or got masks, it is another one."""
        sizes = [[v.name, _size_of(v.path), _size_of(s.mask and s.mask.path)] for v, s in zip(self.views, self.images.sources)]
        return hashlib.sha256(json.dumps(sizes).encode()).hexdigest()[:16]

    def chosen(self) -> str:
        """Return a short hash of the names of the training views if --views leaves some out, else
        an empty string."""
        names = [self.views[i].name for i in self.train] if self.left_out else []
        return hashlib.sha256(json.dumps(names).encode()).hexdigest()[:16] if names else ""

    def poses(self) -> str:
        """Return the poses of up to four views, the first and the last among them, as text that
        `same_poses` compares. They are those of the files, also after `with_cameras`.

        Each view has nine numbers: the centre of its camera in the capture's own frame and unit,
        its forward axis and its down axis.
        """
        if self.posed or not self.views:
            return self.posed
        chosen = sorted({round(i * (len(self.views) - 1) / (SAMPLED - 1)) for i in range(SAMPLED)})
        out = []
        for camera in (self.views[i].camera for i in chosen):
            pose = camera.world_to_cam.double()
            centre = self.world.to_input(-(pose[:3, :3].T @ pose[:3, 3]))
            axes = torch.cat((pose[2, :3], pose[1, :3]))
            out.append(" ".join([*(f"{v:.9g}" for v in centre.tolist()), *(f"{v:.5g}" for v in axes.tolist())]))
        return "; ".join(out)

    def with_cameras(self, change: Callable[[Camera], Camera]) -> Capture:
        """Return the capture with other cameras: `change` of each of its own."""
        return replace(self, views=tuple(replace(v, camera=change(v.camera)) for v in self.views), posed=self.poses())

    def expect_poses(self, poses: object, run: Path | None) -> None:
        """Raise InputError, and close the capture, if its cameras are not where they were (`poses`)
        when `run` was trained."""
        if not same_poses(poses, self.poses()):
            self.images.close()
            raise InputError(
                f"expected the camera poses that {run or 'this run'} was trained with, found others in {self.root} (`capture --overwrite` "
                "computes new ones); restore the former poses, or train anew"
            )


def _size_of(path: Path | None) -> int | None:
    """Return the size of a file in bytes; None without one."""
    return path.stat().st_size if path is not None and path.exists() else None


def same_poses(one: object, other: object) -> bool:
    """Return whether two texts of `Capture.poses` agree.

    Centres may differ by a thousandth of the largest distance between the cameras, and entries of
    the axes by 0.001. A value that is no such text agrees with every other: imported scenes
    have none.
    """
    ours, theirs = _parse_poses(one), _parse_poses(other)
    if ours is None or theirs is None:
        return True
    if ours.shape != theirs.shape:
        return False
    spread = max(float((centres[:, None] - centres).norm(dim=2).max()) for centres in (ours[:, :3], theirs[:, :3]))
    reach = spread or max(1.0, float(ours[:, :3].abs().max()))
    return bool(((ours - theirs).abs() <= 1e-3 * torch.tensor([reach] * 3 + [1.0] * 6, dtype=torch.float64)).all())


def _parse_poses(text: object) -> Tensor | None:
    if not isinstance(text, str) or len(text) > 200 * SAMPLED:
        return None
    try:
        rows = torch.tensor([[float(word) for word in row.split()] for row in text.split(";")], dtype=torch.float64)
    except ValueError:
        return None
    return rows if rows.dim() == 2 and rows.shape[1] == 9 and bool(rows.isfinite().all()) else None
