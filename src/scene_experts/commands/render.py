"""`scene-experts render`: a camera path through a trained scene, as a video or as pictures."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import torch
from rich.console import Console

from scene_experts.api.backend import backend
from scene_experts.arguments.option import Option
from scene_experts.arguments.parse import Command, parse
from scene_experts.commands import PROG
from scene_experts.core.choices import Device, Raster
from scene_experts.core.errors import InputError, expect_at_least
from scene_experts.core.types import Camera
from scene_experts.data.capture import Capture
from scene_experts.evaluate.pictures import join_pictures, to_8bit
from scene_experts.render import as_trained
from scene_experts.training import run_folder
from scene_experts.training.progress import Bar
from scene_experts.view import path_files, paths, video
from scene_experts.view.paint import Look, Show, paint
from scene_experts.view.paths import CameraPath


@dataclass(frozen=True)
class RenderCommand:
    """Render a camera path through a run to a video, or to a folder of PNG files."""

    run: Annotated[Path, Option(value="RUN")]
    """Run folder."""
    out: Path | None = None
    """FILE.mp4 (.mov, .mkv, .webm) or a folder for PNG files; RUN/renders/<path>.mp4 by default."""
    path: str = "auto"
    """orbit, spiral, views (through the captured poses), test (each held-out view as photographed), auto (orbit or spiral, as the
    cameras stand), or a JSON file: ours, or nerfstudio's camera path."""
    seconds: float = 8.0
    """Length of orbit, spiral and views."""
    fps: float | None = None
    """Frames a second; 24, or what the file says."""
    size: str | None = None
    """WIDTHxHEIGHT in px; the training views' by default."""
    show: tuple[Show, ...] = ("picture",)
    """What to show, several beside each other: picture, depth, alpha, experts, entropy, activation."""
    attribute: Literal["opacity", "cov", "color"] = "color"
    """Whose experts are shown."""
    only: tuple[int, ...] = ()
    """Draw the anchors of these experts alone, counted from 1."""
    beside: tuple[Path, ...] = ()
    """Other runs of the same capture to draw beside this one."""
    save_path: Path | None = None
    """Write the path as JSON too (nerfstudio's form if the name ends in .nerfstudio.json)."""
    quality: int = 8
    """Of the video, 1 to 10."""
    data: Annotated[Path | None, Option(short="-s", value="CAPTURE")] = None
    """Where the capture is now, if it moved."""
    step: int | None = None
    """Checkpoint to draw; the newest by default."""
    device: Device = "auto"
    rasterizer: Raster = "auto"


def render(args: list[str]) -> int:
    command = parse(RenderCommand, Command(f"{PROG} render", ("--run",)), args)
    check(command)
    device, rasterize = backend(command.device, command.rasterizer, False, False)
    opened = [run_folder.open_run(run, device, command.step if run == command.run else None) for run in (command.run, *command.beside)]
    for run in opened:
        count = run.scene.traits.experts
        if command.only and max(command.only) > count:
            has = f"experts 1 to {count}" if count else "no experts"
            raise InputError(f"expected --only among the experts of {run.path}, which has {has}, found {max(command.only)}; correct it")
    capture = run_folder.capture_of(opened[0], command.data)
    try:
        for other in opened[1:]:
            if other.capture and other.capture != opened[0].capture:
                raise InputError(f"expected runs of one capture, found another in {other.path}; leave it out of --beside")
        route = path_of(command, capture)
        out = command.out or command.run / "renders" / f"{Path(command.path).stem}.mp4"
        if video.is_video(out):
            video.import_ffmpeg()  # says what is missing before the first frame is drawn
            check_sizes(route)
        if command.save_path:
            save = path_files.write_nerfstudio if command.save_path.name.endswith(".nerfstudio.json") else path_files.write_path
            save(command.save_path, route, capture.world)
        background = torch.tensor(capture.background, device=device)
        with Bar(Console(stderr=True)) as tell:
            frames = drawn(command, opened, route.cameras, rasterize, background, tell)
            if video.is_video(out):
                count = video.write_video(out, frames, route.fps, command.quality)
            else:
                count = video.write_pictures(out, frames)
    finally:
        capture.images.close()
    print(f"wrote {out} ({count} frames, {count / route.fps:.1f} s)")
    return 0


def check(command: RenderCommand) -> None:
    """Raises InputError for flags that no video can have."""
    fps = 1.0 if command.fps is None else command.fps
    expect_at_least([("--seconds", command.seconds, 0.01), ("--fps", fps, 0.1), ("--quality", command.quality, 1)])
    expect_at_least([("--only", number, 1) for number in command.only])
    if command.quality > 10:
        raise InputError(f"expected --quality of at most 10, found {command.quality}; give a smaller number")
    out = command.out
    if out is not None and out.suffix and not video.is_video(out) and not out.is_dir():
        raise InputError(f"expected --out as a folder or a file ending in {', '.join(video.VIDEO)}, found {out}; choose one of those")


def check_sizes(route: CameraPath) -> None:
    """Raises InputError for cameras of several sizes, as captured views may be: a video has one."""
    sizes = sorted({(camera.width, camera.height) for camera in route.cameras})
    if len(sizes) > 1:
        first, last = (f"{width}x{height}" for width, height in (sizes[0], sizes[-1]))
        raise InputError(
            f"expected views of one size for a video, found {len(sizes)} sizes ({first} to {last}); give a folder as --out, or --size"
        )


def drawn(
    command: RenderCommand, opened: list[Any], cameras: tuple[Camera, ...], rasterize: Any, background: torch.Tensor, tell: Bar
) -> Iterator[np.ndarray]:
    """The frames, each as 8-bit RGB: every run in every mode, side by side."""
    only = tuple(number - 1 for number in command.only) or None
    frozen = [run.scene.frozen(run.step) for run in opened]
    for i, camera in enumerate(cameras):
        camera = camera.to(background.device)
        tiles = []
        for run, draws in zip(opened, frozen):
            draw = as_trained(rasterize, run.cfg.antialias)
            looks = [Look(mode, command.attribute, only) for mode in command.show]
            tiles += [paint(run.scene, camera, run.step, draw, background, look, draws) for look in looks]
        yield to_8bit(join_pictures(tiles) if len(tiles) > 1 else tiles[0])
        tell("rendering", i + 1, len(cameras))


def path_of(command: RenderCommand, capture: Capture) -> CameraPath:
    """The path that the flags ask for. Raises InputError for one that is none."""
    size = size_of(command.size)
    if path_files.is_path_file(command.path):
        model = paths.median_camera([v.camera for v in capture.views], size)
        return path_files.read_path(Path(command.path), capture.world, model, size, command.fps)
    fps = command.fps or 24.0
    if command.path == "test":
        chosen = capture.test or capture.train
        return CameraPath(tuple(resized(capture.views[i].camera, size) for i in chosen), command.fps or 2.0)
    return paths.make_path(command.path, capture, max(1, round(command.seconds * fps)), size, fps)


def resized(camera: Camera, size: tuple[int, int] | None) -> Camera:
    """The camera at another size, its picture stretched with it."""
    if size is None:
        return camera
    width, height = size
    factor = torch.tensor([[width / camera.width], [height / camera.height], [1.0]])
    return replace(camera, K=camera.K * factor, width=width, height=height)


def size_of(text: str | None) -> tuple[int, int] | None:
    """Width and height of "640x360". Raises InputError for anything else."""
    if text is None:
        return None
    found = re.fullmatch(r"(\d{1,5})[xX](\d{1,5})", text)
    if not found or not all(16 <= int(v) <= 16384 for v in found.groups()):
        raise InputError(f"expected --size as WIDTHxHEIGHT between 16 and 16384 px, for example 640x360, found '{text}'; correct it")
    return int(found[1]), int(found[2])
