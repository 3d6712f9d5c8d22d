"""`Capture`: photographs with camera poses, ready for training."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Literal, NoReturn

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray

from scene_experts.api import checked
from scene_experts.api.camera import Camera, from_trained, vector
from scene_experts.core.errors import InputError, expect_among
from scene_experts.data import capture as captures
from scene_experts.data import views
from scene_experts.data.fetch.catalog import Numbers, defaults_of
from scene_experts.data.settings import Data
from scene_experts.training import run_folder
from scene_experts.view import paths

MOVED, TURNED = 0.05, 0.97  # share of how far cameras are apart, and cosine: more than poses are refined by


class Capture:
    """Photographs with camera poses, ready for training. `load_capture` returns one.

    Positions, cameras and depths are in the capture's own frame and unit: the frame of its COLMAP
    or transforms.json poses.
    """

    data: Data
    """How the capture was read: its folder, resolution, split and the other arguments of
    `load_capture`."""
    loaded: views.Capture
    """The capture in the trained world, as the package's own modules use it."""
    seed: int
    """Seed of the random points, where the capture has any."""

    numbers: Numbers
    """Numbers of its data set, (name, value), for a scene of the catalog; a training takes them
    where its recipe is given by name."""

    def __init__(self, data: Data, loaded: views.Capture, seed: int = 0, numbers: Numbers = ()) -> None:
        self.data, self.loaded, self.seed, self.numbers = data, loaded, seed, numbers

    @property
    def name(self) -> str:
        """The name of the capture's folder."""
        return self.loaded.name

    @property
    def path(self) -> Path:
        """The capture's folder."""
        return self.loaded.root

    @property
    def names(self) -> list[str]:
        """Names of the photographs, as the capture states them (COLMAP: relative to the image
        folder), in the order of the views."""
        return [view.name for view in self.loaded.views]

    @property
    def cameras(self) -> list[Camera]:
        """The cameras of all photographs, at the resolution that the capture was loaded with;
        camera i is that of view i."""
        return [from_trained(view.camera, self.loaded.world) for view in self.loaded.views]

    @property
    def train_cameras(self) -> list[Camera]:
        """The cameras of the views that a training sees."""
        return self._cameras(self.loaded.train)

    @property
    def test_cameras(self) -> list[Camera]:
        """The cameras of the held-out views, which no training sees; empty with the split
        "none"."""
        return self._cameras(self.loaded.test)

    @property
    def background(self) -> tuple[float, float, float]:
        """RGB in [0, 1] behind the scene."""
        return self.loaded.background

    @property
    def warnings(self) -> tuple[str, ...]:
        """Remarks on the capture, one sentence each, for example on dropped views or few points."""
        return self.loaded.warnings

    @property
    def points(self) -> tuple[NDArray[np.float64], NDArray[np.uint8]]:
        """The 3D points that a training starts from, or with the start "dense" computes more from:
        positions [P, 3] float64, and colours [P, 3] uint8, RGB."""
        points = self.loaded.points
        if points is None:
            return np.zeros((0, 3)), np.zeros((0, 3), dtype=np.uint8)
        return self.loaded.world.to_input(points.xyz).numpy(), points.rgb.numpy().copy()

    @property
    def centre(self) -> NDArray[np.float64]:
        """The point [3] that the training cameras look at: the nearest to all their optical
        axes."""
        return self.loaded.world.to_input(paths.analyse_cameras(self.loaded).centre).numpy()

    @property
    def up(self) -> NDArray[np.float64]:
        """The unit vector [3] that points upwards in the training pictures, on average."""
        return paths.analyse_cameras(self.loaded).up.numpy()

    def photo(self, view: int | str | Camera) -> NDArray[np.float32]:
        """Return the photograph of a view, undistorted and at the resolution that the capture was
        loaded with.

        Args:
            view: Index of the view, its name, or its camera.

        Returns:
            [H, W, 3] float32, RGB in [0, 1].

        Raises:
            InputError: The capture has no such view, or its file cannot be read.
        """
        return self.loaded.frame(self._index(view)).rgb.numpy().astype(np.float32) / np.float32(255)

    def mask(self, view: int | str | Camera) -> NDArray[np.float32] | None:
        """Return the mask of a view.

        Args:
            view: Index of the view, or its camera.

        Returns:
            [H, W] float32 in [0, 1], where 1 counts and 0 is ignored; None if every pixel counts.

        Raises:
            InputError: The capture has no such view, or its file cannot be read.
        """
        mask = self.loaded.frame(self._index(view)).mask
        return None if mask is None else mask.numpy()

    def look_at(
        self,
        eye: ArrayLike,
        target: ArrayLike | None = None,
        up: ArrayLike | None = None,
        *,
        size: tuple[int, int] | None = None,
        fov: float | None = None,
    ) -> Camera:
        """Return a camera that looks at a point, with the lens of the photographs.

        Args:
            eye: [3] Centre of the camera.
            target: [3] Point in the middle of the picture. Default: `centre`.
            up: [3] Direction that points upwards in the picture. Default: `up`. If it is parallel
                to the line of sight, the coordinate axis that is most perpendicular to the line of
                sight replaces it.
            size: Width and height of the picture, px. Default: those of the median training camera.
            fov: Vertical field of view, degrees, between 0 and 180. Default: that of the median
                training camera.

        Raises:
            InputError: `eye` and `target` are the same point, or a value is out of range.
        """
        seen = paths.analyse_cameras(self.loaded)
        model = paths.median_camera(seen.cameras, checked.size("size", size))
        aim = self.centre if target is None else vector(target, "target")
        upward = self.up if up is None else vector(up, "up")
        angle = float(np.degrees(model.fov)) if fov is None else checked.real("fov", fov)
        return Camera.look_at(eye, aim, upward, width=model.width, height=model.height, fov=angle)

    def camera_path(
        self, kind: Literal["auto", "orbit", "spiral", "views"] = "auto", *, frames: int = 192, size: tuple[int, int] | None = None
    ) -> list[Camera]:
        """Return cameras along a path through the scene.

        Args:
            kind: "orbit" goes once around `centre`. "spiral" circles in front of a scene that faces
                one way. "views" moves smoothly through the training cameras. "auto" chooses an
                orbit if the cameras surround the scene, else a spiral, or "views" where a spiral
                looks where no photograph does.
            frames: Number of cameras, at least 1.
            size: Width and height of the pictures, px. Default: those of the median training
                camera.

        Raises:
            InputError: The kind is unknown, or there are no frames.
        """
        expect_among("kind", kind, paths.NAMES)
        made = paths.make_path(kind, self.loaded, checked.integer("frames", frames, 1), checked.size("size", size))
        return [from_trained(camera, self.loaded.world) for camera in made.cameras]

    def with_seed(self, seed: int) -> Capture:
        """Return the capture with the random points of another seed; the capture itself if it has
        no random points."""
        if seed == self.seed or not self.loaded.random_points:
            return self
        return Capture(self.data, captures.load(self.data, seed), seed, self.numbers)

    def _cameras(self, indices: Sequence[int]) -> list[Camera]:
        return [from_trained(self.loaded.views[i].camera, self.loaded.world) for i in indices]

    def _index(self, view: int | str | Camera) -> int:
        if isinstance(view, str):
            if view in self.names:
                return self.names.index(view)
            raise InputError(f"expected the name of a view of {self.name}, found {view!r}; choose one of `Capture.names`")
        if not isinstance(view, (int, np.integer, Camera)):
            raise InputError(
                f"expected a view of {self.name} as an index, a name or a camera, found {view!r}; choose one of `Capture.cameras`"
            )
        index, count = int(view.view if isinstance(view, Camera) else view), len(self.loaded.views)
        if not 0 <= index < count:
            what = "a camera of no photograph" if isinstance(view, Camera) and index < 0 else str(index)
            raise InputError(f"expected a view from 0 to {count - 1} of {self.name}, found {what}; choose one of `Capture.cameras`")
        if isinstance(view, Camera) and not self._took(index, view):
            raise InputError(f"expected a camera of {self.name}, found one of a capture with other views; choose one of `Capture.cameras`")
        return index

    def _took(self, index: int, camera: Camera) -> bool:
        """Return whether a camera may have taken the photograph of a view: no other view is nearer
        to its place, and it looks the same way. Refined poses differ a little."""
        places = torch.stack([view.camera.position for view in self.loaded.views]).double()
        away = (self.loaded.world.to_input(places) - torch.from_numpy(camera.position)).norm(dim=1)
        forward = self.loaded.views[index].camera.world_to_cam[2, :3].double().numpy()
        reach = max(float(away.max()), self.loaded.extent / self.loaded.world.scale)
        near = float(away[index]) <= min(float(away.min()) + 1e-4 * reach, MOVED * reach)
        return near and float(forward @ camera.world_to_camera[2, :3]) > TURNED

    def __reduce__(self) -> NoReturn:
        where = f"load_capture({str(self.loaded.root)!r})"
        raise InputError(f"expected something that can be copied to another process, found a capture; use {where} there")

    def __repr__(self) -> str:
        train, test = len(self.loaded.train), len(self.loaded.test)
        return f"Capture({self.name!r}, {train} training views, {test} held-out views)"


def load_capture(
    path: str | Path,
    *,
    images: str | None = None,
    resolution: str = "auto",
    split: str = "auto",
    leave_out: Sequence[str] = (),
    missing: Literal["error", "drop"] = "error",
    normalise: Literal["extent", "none"] | None = None,
    init: Literal["auto", "points", "dense", "random"] = "auto",
    points: str | Path | None = None,
    model: str | None = None,
    max_views: int | None = None,
    near: float | None = None,
    ignore_principal_point: bool = False,
    background: tuple[float, float, float] | None = None,
    seed: int = 0,
) -> Capture:
    """Load a capture: a COLMAP folder (images/, sparse/0/), or a folder with transforms.json,
    transforms_train.json or the poses of RealityCapture, Metashape, Bundler or Polycam.

    Args:
        path: Folder of the capture, or "catalog:SCENE" for a scene that `scene-experts download`
            fetched.
        images: Image folder inside the capture, for example "images_4".
        resolution: "as-is", "factor:N" (divide by N), "longest:PX" (longest side), "cap1600" (at
            most 1600 px wide), "share:S" (share of the size that cap1600 gives), "inria:N" (the
            folder images_N), or "auto": the paper's for a scene of the catalog, else cap1600.
        split: Which views are held out: "mod8" (every 8th), "mod:N", "fold:K/N" (every Nth from the
            Kth), "first:N", "none", "files" (as the files of the capture state), or "auto": "files" if
            they state it, "none" with fewer than 12 views, else "mod8".
        leave_out: Names of photographs that are neither trained on nor held out, for example
            ["DSC_0423.JPG"]. Folder and extension may be omitted where a name stays unambiguous.
        missing: "drop" leaves out views without a photograph instead of raising InputError.
        normalise: "extent" trains in a world that is scaled to a camera extent of 5, "none" in the
            capture's own unit. Default: "none" for a scene of the catalog, else "extent".
            Everything that the API returns is in the capture's own unit either way.
        init: Start from the capture's 3D "points", from "dense" ones that a training computes from
            its photographs, or from "random" ones. "auto": "dense" where the recipe asks for it
            (`dense_views`), else "points", with some far away where it asks for them
            (`far_points`).
        points: File of points to start from instead: PLY, or COLMAP's points3D.bin or points3D.txt,
            in the frame of the capture's poses.
        model: Which reconstruction of the capture is read if it has several: a folder ("sparse/1")
            or a file of poses inside it. Default: that with the most photographs.
        max_views: Use at most this many views, evenly spread.
        near: Near plane, trained units, above 0. Default: the smaller of 0.2 and 0.02 times the
            camera extent.
        ignore_principal_point: Move every principal point to the middle of its picture, as the
            reference implementations do.
        background: RGB in [0, 1] behind the scene. Default: white for NeRF-synthetic captures, else
            black.
        seed: Seed of the random points, at least 0.

    Raises:
        InputError: The folder holds no usable capture, or an argument is invalid.
    """
    if not isinstance(path, (str, Path)) or not str(path):
        raise InputError(f"expected the folder of a capture, found {path!r}; give its path")
    brought = defaults_of(path)
    cloud = None if points is None else Path(points)
    data = checked.fields(Data, {**locals(), "path": Path(path), "points": cloud, "normalise": normalise or brought.normalise})
    seed = checked.integer("seed", seed, 0)
    data = run_folder.named(data)
    return Capture(data, captures.load(data, seed), seed, brought.numbers)
