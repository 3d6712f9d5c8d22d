"""Renders a camera path through one or more runs to a video or to PNG files."""

from __future__ import annotations

import logging
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
import torch

from scene_experts.core.errors import InputError
from scene_experts.core.progress import Progress
from scene_experts.core.types import Camera, Mode
from scene_experts.data.capture import Capture
from scene_experts.data.transform import read_transform
from scene_experts.data.views import same_poses
from scene_experts.evaluate.pictures import join_pictures, to_8bit
from scene_experts.render import Rasterizer, as_trained
from scene_experts.training.run_folder import OpenRun
from scene_experts.view import path_files, paths, video
from scene_experts.view.film_options import FilmOptions
from scene_experts.view.paint import Look, measure_depth, paint
from scene_experts.view.paths import CameraPath

log: logging.Logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class Film:
    """Runs of one capture along one camera path."""

    options: FilmOptions
    runs: Sequence[OpenRun]
    capture: Capture
    path: CameraPath
    captures: Sequence[Capture]
    """The capture as each run sees it, with its own world, background and near plane; the first is
    `capture`, whose world the path's cameras are in."""

    def write(self, out: Path, rasterize: Rasterizer, device: str, progress: Progress) -> int:
        """Write a video, or PNG files if `out` is a folder, and return the number of frames. A folder
        that shows depth has the first run's as float32 too: along the camera's axis, in the
        capture's unit, 0 where nothing is drawn. Its frames.json has the names of the photographs
        that --path test draws.

        Raises InputError if a video is impossible, RunError if the encoder fails or the disk is
        full.
        """
        if not video.is_video(out):
            depths = partial(self.draw_depth, rasterize, device) if "depth" in self.options.show else None
            return video.write_pictures(out, self.draw_frames(rasterize, device, progress), depths, self.path.names)
        video.import_ffmpeg()  # reports a missing package before the first frame is drawn
        self.expect_one_size()
        return video.write_video(out, self.draw_frames(rasterize, device, progress), self.path.fps, self.options.quality)

    def write_path(self, out: Path) -> None:
        """Write the camera path as JSON: nerfstudio's if the name ends in .nerfstudio.json."""
        write = path_files.write_nerfstudio if out.name.endswith(".nerfstudio.json") else path_files.write_path
        write(out, self.path, self.capture.world)

    def draw_frames(self, rasterize: Rasterizer, device: str, progress: Progress) -> Iterator[np.ndarray]:
        """Yield the frames as 8-bit RGB [H, W, 3]: every run in every mode, side by side."""
        only = tuple(number - 1 for number in self.options.only) or None
        looks = [Look(show=show, attribute=self.options.attribute, only=only) for show in self.options.show]
        behind = [torch.tensor(capture.background, device=device) for capture in self.captures]
        frozen = [run.scene.frozen(run.step) for run in self.runs]
        for i, camera in enumerate(self.path.cameras):
            tiles = []
            for run, capture, background, draws in zip(self.runs, self.captures, behind, frozen):
                draw, own = as_trained(rasterize, run.config.train.antialias), self.seen_in(capture, camera).to(device)
                tiles += [paint(run.scene, own, run.step, draw, background, look, draws) for look in looks]
            yield to_8bit(join_pictures(tiles) if len(tiles) > 1 else tiles[0])
            progress("rendering", i + 1, len(self.path.cameras))

    def seen_in(self, capture: Capture, camera: Camera) -> Camera:
        """Return a camera of the path in the world of a run, with the near plane of that run."""
        if capture is self.capture:
            return camera
        pose = camera.world_to_cam
        moved = capture.world.camera_from_input(self.capture.world.camera_to_input(replace(camera, world_to_cam=pose.double())))
        return replace(moved, world_to_cam=moved.world_to_cam.to(pose.dtype), near=capture.views[0].camera.near)

    @torch.no_grad()
    def draw_depth(self, rasterize: Rasterizer, device: str, frame: int) -> np.ndarray:
        """Return the depth [H, W] of the first run in a frame, float32, see `write`."""
        run, camera = self.runs[0], self.path.cameras[frame].to(device)
        draw = as_trained(rasterize, run.config.train.antialias)
        decoded = run.scene(camera, run.step, Mode.DRAW, draw.visible)
        drawn = draw(decoded.gaussians, camera, torch.tensor(self.capture.background, device=device))
        return (measure_depth(drawn) / self.capture.world.scale).cpu().numpy()

    def expect_one_size(self) -> None:
        """Raise InputError for cameras of several sizes. A video has one size."""
        sizes = sorted({(camera.width, camera.height) for camera in self.path.cameras})
        if len(sizes) > 1:
            first, last = (f"{width}x{height}" for width, height in (sizes[0], sizes[-1]))
            raise InputError(
                f"expected views of one size for a video, found {len(sizes)} sizes ({first} to {last}); give --size, or a folder as --out"
            )


def make_film(options: FilmOptions, runs: Sequence[OpenRun], captures: Sequence[Capture]) -> Film:
    """Return the film of `runs`.

    captures: As each run sees it; the path is in the world of the first.

    Raises InputError for unknown experts and an unknown path.
    """
    for run in runs:
        count = run.scene.traits.experts
        if options.only and max(options.only) > count:
            has = f"experts 1 to {count}" if count else "no experts"
            raise InputError(f"expected --only among the experts of {run.path}, which has {has}, found {max(options.only)}; change it")
    return Film(options, runs, captures[0], make_path(options, captures[0]), captures)


def expect_one_capture(runs: Sequence[OpenRun]) -> None:
    """Raise InputError for runs of different captures."""
    for other in runs[1:]:
        if (other.capture and other.capture != runs[0].capture) or not same_poses(other.poses, runs[0].poses):
            raise InputError(
                f"expected runs of one capture, with one --resolution and --split, found another in {other.path}; leave it out of --beside"
            )


def check_out(out: Path | None) -> None:
    """Raise InputError for a name that is neither that of a video nor of a folder."""
    if out is not None and out.suffix and not video.is_video(out) and not out.is_dir():
        raise InputError(f"expected --out as a folder or a file ending in {', '.join(video.VIDEO)}, found {out}; choose one of those")


def make_path(options: FilmOptions, capture: Capture) -> CameraPath:
    """Return the camera path of the options. Raises InputError if it is unknown."""
    size = options.pixels()
    if path_files.is_path_file(options.path):
        _warn_of_length(options)
        model = paths.median_camera([v.camera for v in capture.views], size)
        moved = None if options.transform is None else read_transform(options.transform, capture)
        return path_files.read_path(Path(options.path), capture.world, model, size, options.fps, moved)
    if options.transform is not None:
        raise InputError(f"expected a path of nerfstudio with --transform, found --path {options.path}; leave --transform out")
    fps = options.fps or 24.0
    if options.path == "test":
        _warn_of_length(options)
        if not capture.test:
            log.warning("no photograph is held out: --path test shows the training views")
        chosen = capture.test or capture.train
        views = [capture.views[i] for i in chosen]
        cameras, names = tuple(resize_camera(view.camera, size) for view in views), tuple(view.name for view in views)
        return CameraPath(cameras, options.fps or 2.0, names)
    return paths.make_path(options.path, capture, options.frames or max(1, round(options.seconds * fps)), size, fps)


def _warn_of_length(options: FilmOptions) -> None:
    given = [flag for flag, on in (("--frames", options.frames is not None), ("--seconds", options.seconds != FilmOptions().seconds)) if on]
    if given:
        log.warning("%s: no effect with --path %s, whose cameras are all drawn; leave it out", " and ".join(given), options.path)


def resize_camera(camera: Camera, size: tuple[int, int] | None) -> Camera:
    """Return the camera with another picture size and the same vertical field of view, as the other
    paths have it.

    A wider picture shows more at the sides, a narrower one less; nothing is stretched.
    """
    if size is None:
        return camera
    width, height = size
    factor = height / camera.height
    K = camera.K * torch.tensor([[factor], [factor], [1.0]])
    K[0, 2] += (width - factor * camera.width) / 2
    return replace(camera, K=K, width=width, height=height)
