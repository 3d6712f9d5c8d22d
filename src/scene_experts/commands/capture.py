"""`scene-experts capture`: photographs or a video to a capture that `train` takes."""

from __future__ import annotations

import shlex
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

from scene_experts.arguments.option import Option
from scene_experts.arguments.parse import Command, parse
from scene_experts.commands import PROG
from scene_experts.core.errors import few
from scene_experts.core.signals import handled
from scene_experts.sfm.options import Options

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
    options: Annotated[Options, Option(name="")] = Options()
    overwrite: bool = False
    """Replace the poses that are there, once new ones are whole, and the images that an earlier `capture` copied."""


def capture(args: list[str]) -> int:
    command = parse(CaptureCommand, Command(f"{PROG} capture", ("--photos",)), args)
    command.options.check()

    from rich.console import Console

    from scene_experts.sfm.reconstruct import reconstruct
    from scene_experts.training.progress import Bar

    console = Console(highlight=False)
    say = lambda text: console.print(text, soft_wrap=True, markup=False)  # noqa: E731
    with handled(interrupt), Bar(console) as bar:
        note = reconstruct(command.photos, command.out, command.options, overwrite=command.overwrite, say=say, progress=bar)
    for line in told(note):
        say(line)
    say(f"next: {PROG} train moe-gs --data {shlex.quote(str(command.out))} --out RUN")
    return 0


def interrupt(*_: object) -> None:
    """SIGTERM and a closed terminal end the work as Ctrl-C does: COLMAP's process with it."""
    raise KeyboardInterrupt


def told(note: dict[str, Any]) -> list[str]:
    """What was found, and what to do where it is little."""
    from scene_experts.training.progress import clock

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
