"""`scene-experts capture`: photographs or a video to a capture that `train` takes."""

from __future__ import annotations

import shlex
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

from rich.console import Console

from scene_experts.arguments.option import Option
from scene_experts.arguments.parse import Command, parse
from scene_experts.commands import PROG
from scene_experts.core.errors import InputError, expect_at_least, few
from scene_experts.core.signals import handled
from scene_experts.sfm import reconstruct as run
from scene_experts.sfm.frames import MOST_FRAMES
from scene_experts.training.progress import Bar, clock

FEW = 0.9  # a smaller share of photographs with a pose is worth a word of advice


@dataclass(frozen=True)
class CaptureCommand:
    """Find poses and points of photographs, or of a video's sharpest frames (COLMAP, in a process of its own): what `train` needs.

    `capture PHOTOS --out CAPTURE` copies the photographs into CAPTURE/images: blanks in names become _, those that EXIF turns are written
    upright. The same command goes on where it was stopped.
    """

    photos: Annotated[Path, Option(value="PHOTOS")]
    """Folder of photographs (JPEG, PNG, ...; subfolders too), or a video. CAPTURE/images itself stays as it is."""
    out: Annotated[Path, Option(value="CAPTURE")]
    """Folder of the capture: OUT/images, OUT/sparse/0, OUT/capture.json."""
    frames: int = run.Options.frames
    """Of a video: how many frames to take, the sharpest of as many stretches."""
    matching: run.Matching = run.Options.matching
    """Which photographs are compared: all with all, or neighbours in order of names (a video, a walk). auto: all up to 300."""
    camera_model: run.CameraModel = run.Options.camera_model
    """COLMAP's model of the lens. Photographs of one size, camera and focal length share one."""
    mapper: run.Mapper = run.Options.mapper
    """COLMAP's incremental mapper or GLOMAP's; auto: the first, and where it leaves a tenth without pose, the better of both."""
    max_side: int = run.Options.max_side
    """Longest side, px, at which features are sought; the photographs stay as they are."""
    threads: int = run.Options.threads
    """0: all cores this process may use."""
    seed: int = run.Options.seed
    """Of COLMAP's random choices."""
    overwrite: bool = False
    """Replace the poses that are there, once new ones are whole, and the images that an earlier `capture` copied."""


def capture(args: list[str]) -> int:
    command = parse(CaptureCommand, Command(f"{PROG} capture", ("--photos",)), args)
    least = {"frames": 3, "max_side": 64, "threads": 0, "seed": 0}
    expect_at_least([(f"--{name.replace('_', '-')}", getattr(command, name), low) for name, low in least.items()])
    if command.frames > MOST_FRAMES:
        raise InputError(f"expected --frames of at most {MOST_FRAMES:,}, found {command.frames:,}; give fewer: 100 to 300 make a scene")
    console = Console(highlight=False)
    say = lambda text: console.print(text, soft_wrap=True, markup=False)  # noqa: E731
    options = run.Options(**{name: getattr(command, name) for name in vars(run.Options())})
    with handled(interrupt), Bar(console) as bar:
        note = run.reconstruct(command.photos, command.out, options, overwrite=command.overwrite, say=say, progress=bar)
    for line in told(note):
        say(line)
    say(f"next: {PROG} train moe-gs --data {shlex.quote(str(command.out))} --out RUN")
    return 0


def interrupt(*_: object) -> None:
    """SIGTERM and a closed terminal end the work as Ctrl-C does: COLMAP's process with it."""
    raise KeyboardInterrupt


def told(note: dict[str, Any]) -> list[str]:
    """What was found, and what to do where it is little."""
    have, all_, without = note["with_pose"], note["photographs"], note["without_pose"]
    lines = [
        f"{have} of {all_} photographs have a pose: {note['points']:,} points, {note['observations']:.0f} seen in a photograph, "
        f"{note['error']:.2f} px off on average; {note['mapper']} mapper, {clock(note['seconds'])} min"
    ]
    if without:
        lines.append(f"without a pose: {few(without, 8)}")
    if note["apart"]:
        parts = ", ".join(map(str, note["apart"]))
        lines.append(f"warning: {parts} of these fit together, but not with the others: take photographs in between")
    if have < FEW * all_:
        more = "" if note["all_compared"] else "; --matching exhaustive --overwrite may find more"
        lines.append(f"warning: each thing should be in three photographs or more, from different places and sharp{more}")
    return lines
