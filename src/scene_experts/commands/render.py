"""`scene-experts render`: a camera path through a trained scene, as a video or as pictures."""

from __future__ import annotations

import sys
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from scene_experts.arguments.option import Option
from scene_experts.arguments.parse import Command, parse
from scene_experts.commands import PROG
from scene_experts.core.choices import Device, Raster
from scene_experts.core.fields import check_fields
from scene_experts.view.film_options import FilmOptions

if TYPE_CHECKING:
    from scene_experts.training.run_folder import OpenRun

FIRST = ("out", "path", "seconds", "size", "show", "only", "beside", "step", "data", "device")
"""The options that people use first, for --help."""


@dataclass(frozen=True)
class RenderCommand:
    """Render a camera path through a run to a video, or to a folder of PNG files."""

    run: Annotated[Path, Option(value="RUN")]
    """Run folder."""
    out: Path | None = None
    """Video to write (.mp4, .mov, .mkv or .webm), or a folder for PNG files, with --show depth also
    for TIFF files of depths (float32, the capture's unit); by default RUN/renders/NAME.mp4 with the
    path's name and what is shown."""
    options: Annotated[FilmOptions, Option(name="")] = FilmOptions()
    beside: Annotated[tuple[Path, ...], Option(value="RUN")] = ()
    """Other runs of the same capture to show side by side."""
    save_path: Path | None = None
    """Also write the camera path as JSON, in nerfstudio's format if the name ends in
    .nerfstudio.json."""
    data: Annotated[Path | None, Option(short="-s", value="CAPTURE")] = None
    """Folder of the capture, if it has moved."""
    step: int | None = None
    """Iteration of the checkpoint to render; by default the newest."""
    device: Device = "auto"
    """Device to render on. auto: CUDA if available."""
    rasterizer: Raster = "auto"
    """Rasteriser. auto: the fastest that works on the device."""


def render(args: list[str]) -> int:
    command = parse(RenderCommand, Command(f"{PROG} render", ("run",), FIRST), args)
    check_fields(command.options)

    from rich.console import Console

    from scene_experts.api.backend import backend
    from scene_experts.training import run_folder
    from scene_experts.training.progress import ProgressBar
    from scene_experts.view.film import check_out, expect_one_capture, make_film
    from scene_experts.view.paths import SEEN, UNSEEN, count_unseen

    check_out(command.out)
    device, rasterize = backend(command.device, command.rasterizer, False, False)
    runs = [run_folder.open_run(run, device, command.step if run == command.run else None) for run in (command.run, *command.beside)]
    expect_one_capture(runs)
    seen = [capture := run_folder.capture_of(runs[0], command.data)]
    try:
        for run in runs[1:]:
            seen.append(capture if is_alike(run, runs[0]) else run_folder.capture_of(run, place_of(runs[0], command.data)))
        film = make_film(command.options, runs, seen)
        unseen = count_unseen(film.path, capture)
        if unseen > UNSEEN * len(film.path):
            text = f"{unseen} of {len(film.path)} frames look in a direction that no photograph has (within {SEEN:.0f} degrees)"
            nearer = "--path views" if command.options.path == "spiral" else "--path spiral or views"
            print(f"warning: {text} and may show fog; {nearer} stays near the photographs", file=sys.stderr)
        if command.save_path:
            film.write_path(command.save_path)
        shown = name_shown(command)
        out = command.out or command.run / "renders" / f"{Path(command.options.path).stem}{shown}.mp4"
        with ProgressBar(Console(stderr=True, markup=False)) as tell:
            count = film.write(out, rasterize, device, tell)
    finally:
        for each in seen:
            each.images.close()
    print(f"wrote {out} ({count} frames, {count / film.path.fps:.1f} s)")
    return 0


def name_shown(command: RenderCommand) -> str:
    """Return the part of a video's name that says what it shows; empty for the pictures of the
    run."""
    options = command.options
    parts = [] if options.show == ("picture",) else list(options.show)
    parts += [options.attribute] if options.attribute != FilmOptions().attribute else []
    parts += [f"only{'-'.join(map(str, options.only))}"] if options.only else []
    parts += [f"beside-{path.resolve().name}" for path in command.beside]
    parts += [] if command.step is None else [str(command.step)]
    return "".join(f"_{part}" for part in parts)


def is_alike(run: OpenRun, first: OpenRun) -> bool:
    """Return whether two runs read their capture with the same settings, the background and the
    near plane among them."""
    return run.cameras is None and replace(run.config.data, path=first.config.data.path) == first.config.data


def place_of(run: OpenRun, data: Path | None) -> Path | None:
    """Return where the capture of a run is, for other runs on it; None for a scene without one."""
    return data if data is not None or run.cameras is not None else run.config.data.path
