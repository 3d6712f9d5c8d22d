"""`scene-experts info` and `doctor`: commands that look and change nothing."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from scene_experts.arguments.parse import Command, parse
from scene_experts.commands import PROG
from scene_experts.core.errors import InputError
from scene_experts.data.fetch.catalog import defaults_in
from scene_experts.data.settings import Data


def info(args: list[str]) -> int:
    about = (
        "Show what a capture contains: views, picture sizes, cameras, points, split and warnings; "
        "for a run folder, its recipe, size, scores and files; or what the file of a scene holds."
    )
    brought = {"normalise": defaults_in(args).normalise}
    data = parse(Data, Command(f"{PROG} info", ("data",), about=about, defaults=brought), args)

    from rich.console import Console

    from scene_experts.commands.next_step import propose_training
    from scene_experts.data import capture as captures
    from scene_experts.data.summary import print_summary
    from scene_experts.training import run_folder

    console = Console(markup=False, highlight=False)
    if (run := is_run(data.path)) or is_scene(data.path):
        from scene_experts.commands.run_facts import print_file, print_run

        if given := [word for word in args if word.startswith("-") and word not in ("-s", "--data")]:
            what = "a run folder" if run else "a scene"
            raise InputError(f"expected no {given[0]} with {what}, found {data.path}; leave it out, or give a capture")
        (print_run if run else print_file)(data.path, console)
        return 0
    capture = captures.load(run_folder.named(data), allow_no_points=True)
    print_summary(capture, console)
    lens = capture.images.sources[0].lens
    console.print(propose_training(data, lens.width, lens.height, len(capture.views)), markup=False, soft_wrap=True)
    return 0


def is_run(folder: Path) -> bool:
    """Whether a folder is a run folder and no capture."""
    from scene_experts.data.readers import is_capture

    return (folder / "config.json").is_file() and (folder / "checkpoints").is_dir() and not is_capture(folder)


def is_scene(path: Path) -> bool:
    """Whether a path is a file of a known format, a folder of SOG or a result folder, and no capture."""
    from scene_experts.data.readers import is_capture
    from scene_experts.files.registry import recognise, scene_file
    from scene_experts.files.result_folder import is_result

    if is_result(path) or not scene_file(path).is_file():
        return is_result(path) and not is_capture(path)
    try:
        recognise(scene_file(path))
    except InputError:
        return False
    return not is_capture(path)


@dataclass(frozen=True)
class DoctorCommand:
    """Check which backends work on this machine, why the others do not, and what to install."""


def doctor(args: list[str]) -> int:
    parse(DoctorCommand, Command(f"{PROG} doctor"), args)

    from rich.console import Console

    from scene_experts.commands import doctor as checks

    return checks.run(Console(markup=False, highlight=False))
