"""`scene-experts make`: photographs or a video to a page."""

from __future__ import annotations

import shlex
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from scene_experts.arguments.option import Option
from scene_experts.arguments.parse import Command, parse
from scene_experts.commands import PROG
from scene_experts.core.fields import NotNegative
from scene_experts.core.signals import handled
from scene_experts.sfm.options import SourceOptions

FIRST = ("out", "minutes", "scores", "open", "frames", "nadir")
"""The options that people use first, for --help."""


@dataclass(frozen=True)
class MakeCommand:
    """Make a web page with a 3D scene from photographs or a video: camera poses, training and page
    in one call.

    Repeat the command to continue where it was interrupted. `capture`, `train`, `eval` and `export`
    do the same in steps, with all options.
    """

    photos: Annotated[Path, Option(value="PHOTOS")]
    """Folder of photographs, a video, or a capture."""
    out: Annotated[Path | None, Option(value="FOLDER")] = None
    """Folder to write; by default the name of PHOTOS with -scene, in this folder."""
    minutes: NotNegative = 0.0
    """Time for the whole; it decides iterations, resolution and effort. 0: half of the iterations
    that `info` proposes."""
    scores: bool = False
    """Hold out every 8th photograph of at least 12, score it, and write a report. Otherwise all photographs are
    trained on."""
    open: bool = False
    """Open the page in the browser at the end."""
    options: Annotated[SourceOptions, Option(name="")] = SourceOptions()


def make(args: list[str]) -> int:
    command = parse(MakeCommand, Command(f"{PROG} make", ("photos",), FIRST), args)

    from webbrowser import open_new_tab

    from scene_experts.commands.capture import interrupt
    from scene_experts.core.console import LastingConsole
    from scene_experts.making.make import make as run
    from scene_experts.training.progress import ProgressBar, format_duration

    console = LastingConsole(markup=False, highlight=False)
    say = lambda text: console.print(text, soft_wrap=True, markup=False)  # noqa: E731
    with handled(interrupt), ProgressBar(console) as bar:
        made = run(
            command.photos,
            command.out,
            minutes=command.minutes or None,
            scores=command.scores,
            options=command.options,
            say=say,
            progress=bar,
        )
    times = ", ".join(f"{name} {format_duration(took)}" for name, took in made.seconds.items() if took >= 1)
    say(f"time: {times}" if times else "everything was there already")
    if made.psnr is not None:
        held = (
            "photographs held out (the report has each; a mean of few says little)"
            if command.scores
            else "the photographs that were trained on (what lies between them is not scored)"
        )
        say(f"PSNR: {made.psnr:.2f} dB on {held}")
    if made.report is not None:
        say(f"report: {made.report}")
    size = made.page.stat().st_size / 1e6
    say(f"open {made.page} in a browser ({size:.1f} MB, one file to share)")
    export = shlex.join([PROG, "export", str(made.run), "--format", "sog", "--out", "scene.sog"])
    say(f"next: {export}  # other files, of the run in {made.run}")
    if command.open:
        open_new_tab(made.page.resolve().as_uri())
    return 0
