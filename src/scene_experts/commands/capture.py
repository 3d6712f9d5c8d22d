"""`scene-experts capture`: photographs or a video to a capture for `train`."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any

from scene_experts.arguments.option import Option
from scene_experts.arguments.parse import Command, parse
from scene_experts.commands import PROG
from scene_experts.core.signals import handled
from scene_experts.sfm.options import SfmOptions


@dataclass(frozen=True)
class CaptureCommand:
    """Find camera poses and 3D points for photographs or a video with COLMAP, and write a capture
    for `train`.

    The photographs are copied to CAPTURE/images. Spaces in their names become underscores, and
    rotated photographs are written upright. Repeat the command to continue an interrupted
    reconstruction.
    """

    photos: Annotated[Path, Option(value="PHOTOS")]
    """Folder of photographs (JPEG, PNG and others, also in subfolders), or a video. CAPTURE/images
    is used in place."""
    out: Annotated[Path, Option(value="CAPTURE")]
    """Folder of the capture to write: images/, sparse/0/ and capture.json."""
    options: Annotated[SfmOptions, Option(name="")] = SfmOptions()
    overwrite: bool = False
    """Replace existing poses and copied photographs once the new reconstruction is complete."""


def capture(args: list[str]) -> int:
    command = parse(CaptureCommand, Command(f"{PROG} capture", ("photos",)), args)

    from scene_experts.commands.next_step import propose_training
    from scene_experts.core.console import LastingConsole
    from scene_experts.data.readers.colmap import find_models
    from scene_experts.data.settings import Data
    from scene_experts.sfm.reconstruct import reconstruct
    from scene_experts.sfm.work import PLACES
    from scene_experts.training.progress import ProgressBar

    console = LastingConsole(markup=False, highlight=False)
    say = lambda text: console.print(text, soft_wrap=True, markup=False)  # noqa: E731
    with handled(interrupt), ProgressBar(console) as bar:
        note = reconstruct(command.photos, command.out, command.options, overwrite=command.overwrite, say=say, progress=bar)
    for line in summarise(note):
        say(line)
    width, height = note["size"]
    data = Data(command.out)
    if others := [place.name for place in find_models(command.out) if place != command.out / PLACES["model"]]:
        data = replace(data, model=PLACES["model"])
        say(f"{command.out / 'sparse'} also holds {', '.join(others)} of another reconstruction, left as it is; --model chooses")
    say(propose_training(data, width, height, note["with_pose"]))
    return 0


def interrupt(*_: object) -> None:
    """Handle SIGTERM and a closed terminal like Ctrl-C, which also ends the process of COLMAP."""
    raise KeyboardInterrupt


def summarise(note: dict[str, Any]) -> list[str]:
    """Lines about the result, with advice if few photographs have a pose."""
    from scene_experts.sfm.drift import DRIFT, KEY
    from scene_experts.sfm.lacking import explain_lacking
    from scene_experts.training.progress import format_duration

    lines = [
        f"{note['with_pose']} of {note['photographs']} photographs have a pose: "
        f"{note['points']:,} points, {note['observations']:.0f} points per photograph, "
        f"mean error {note['error']:.2f} px, {note['mapper']} mapper, {format_duration(note['seconds'])} min"
    ]
    if (drift := note.get(KEY) or 0) >= DRIFT:
        lines.append(f"the exposure of the photographs differs by {drift:.2f} stops (standard deviation): `--exposure` learns it")
    tried = note.get("mappers", {})
    if len(tried) > 1:
        posed = " and ".join(f"{count} from the {name} mapper" for name, count in tried.items())
        lines.append(f"poses: {posed}; the result of the {note['mapper']} mapper is kept")
    return lines + explain_lacking(note, "--matching exhaustive --overwrite")
