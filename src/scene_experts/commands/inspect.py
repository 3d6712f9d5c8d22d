"""`scene-experts info` and `doctor`: commands that look and change nothing."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from scene_experts.arguments.parse import Command, parse
from scene_experts.commands import PROG
from scene_experts.core.errors import InputError
from scene_experts.core.io import read_json
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
    from scene_experts.data.views import typical_size
    from scene_experts.training import run_folder

    console = Console(markup=False, highlight=False)
    if (run := is_run(data.path)) or is_scene(data.path):
        from scene_experts.commands.run_facts import print_file, print_run

        if given := [word for word in args if word.startswith("-") and word.partition("=")[0] not in ("-s", "--data")]:
            what = "a run folder" if run else "a scene"
            raise InputError(f"expected no {given[0]} with {what}, found {data.path}; leave it out, or give a capture")
        (print_run if run else print_file)(data.path, console)
        return 0
    capture = captures.load(run_folder.named(data), allow_no_points=True)
    print_summary(capture, console)
    width, height = typical_size((source.lens.width, source.lens.height) for source in capture.images.sources)
    console.print(propose_training(data, width, height, len(capture.views)), markup=False, soft_wrap=True)
    return 0


def is_run(folder: Path) -> bool:
    """Whether a folder is a run folder and no capture."""
    from scene_experts.data.readers import is_capture

    begun = (folder / "checkpoints").is_dir() or (folder / "metrics.jsonl").is_file()
    return (folder / "config.json").is_file() and begun and not is_capture(folder)


def is_scene(path: Path) -> bool:
    """Whether a path is a file, or a folder with a SOG or a result and no capture."""
    from scene_experts.data.readers import is_capture
    from scene_experts.files.registry import scene_file
    from scene_experts.files.result_folder import is_result

    if not path.is_dir():
        return path.is_file()
    result = is_result(path) and any(path.glob("point_cloud/iteration_*/point_cloud.ply"))
    return (result or describes_scene(scene_file(path))) and not is_capture(path)


def describes_scene(file: Path) -> bool:
    """Whether a file is the description in a folder of SOG. Other programs have files of that name,
    too."""
    try:
        found = read_json(file, "description") if file.is_file() else None
    except InputError:
        return False
    return isinstance(found, dict) and bool(found.keys() & {"means", "lodLevels"})


@dataclass(frozen=True)
class DoctorCommand:
    """Check which backends work on this machine, why the others do not, and what to install."""


def doctor(args: list[str]) -> int:
    parse(DoctorCommand, Command(f"{PROG} doctor"), args)

    from rich.console import Console

    from scene_experts.commands import doctor as checks

    return checks.run(Console(markup=False, highlight=False))
