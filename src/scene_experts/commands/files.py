"""`scene-experts export` and `import`: runs to files, files to runs."""

from __future__ import annotations

import shlex
from contextlib import nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from scene_experts.arguments import docs
from scene_experts.arguments.help import columns
from scene_experts.arguments.option import Option
from scene_experts.arguments.parse import Command, parse
from scene_experts.commands import PROG
from scene_experts.data.fetch.catalog import defaults_in
from scene_experts.data.settings import Data
from scene_experts.files.options import Options
from scene_experts.files.registry import GAUSSIANS, READ_ONLY, about, format_named, format_names

FIRST = ("data", "out", "iteration", "images", "resolution", "split")
"""The options of `import` that people use first, for --help."""
HEAVY = 20_000_000  # bytes that are many for a page


@dataclass(frozen=True)
class ExportCommand:
    """Write a trained scene to a file that viewers or later runs open."""

    run: Annotated[Path, Option(value="RUN")]
    """Run folder, or a file or result folder of any format that `import` reads; that needs no
    capture."""
    format: Annotated[tuple[str, ...], Option(value="FORMAT")] = ("compact",)
    """File formats, from the list above. Several standard files share one bake."""
    out: Path | None = None
    """File or folder to write; by default in the run folder or beside the file. A name without a
    suffix is a folder; several formats need one."""
    hub: Annotated[Path | None, Option(value="FOLDER")] = None
    """Write a folder for a model hub: compact and spz (or --format), a picture and a card
    (README.md)."""
    licence: str | None = None
    """With --hub: licence of the photographs, for the card, such as mit or cc-by-4.0."""
    step: int | None = None
    """Iteration of the checkpoint to export; by default the newest."""
    data: Annotated[Path | None, Option(short="-s", value="CAPTURE")] = None
    """Folder of the capture, if a run's has moved, or to measure a file. Measurements, and standard
    files of runs, need the capture."""
    options: Annotated[Options, Option(name="")] = Options()


@dataclass(frozen=True)
class ImportCommand:
    """Make a run folder of a published result or of an exported file, to score, render and convert
    it."""

    source: Annotated[Path, Option(value="RESULT")]
    """Result folder of Scaffold-GS, Octree-GS or 3DGS (with point_cloud/iteration_N), or a file of
    a format in the list above."""
    data: Annotated[Data, Option(name="")]
    out: Annotated[Path, Option(short="-m", value="RUN")]
    """Run folder to write."""
    iteration: int | None = None
    """Iteration of the result folder; by default the newest."""
    transform: Annotated[Path | None, Option(value="FILE")] = None
    """How Gaussians came into the frame of their file, if it is not the capture's: nerfstudio's
    dataparser_transforms.json."""


def export(args: list[str]) -> int:
    """Write a run to one or more files and print what was written."""
    standard = "Files without networks are standard files of plain Gaussians: other scenes are baked for them, which takes minutes."
    text = f"{docs.of_class(ExportCommand)}\n\n{formats_help()}\n\n{standard}"
    command = parse(ExportCommand, Command(f"{PROG} export", ("run",), about=text), args)

    from rich.console import Console

    from scene_experts.core.errors import InputError
    from scene_experts.files import hub
    from scene_experts.files.export import export_several
    from scene_experts.files.lone import open_scene
    from scene_experts.training.memory import reuse_freed
    from scene_experts.training.progress import ProgressBar

    if command.hub is not None and command.out is not None:
        raise InputError(f"expected --hub or --out, found both; leave --out {command.out} out")
    if command.licence is not None and command.hub is None:
        raise InputError(f"expected --licence with --hub, found it alone; leave --licence {command.licence} out or name a folder by --hub")
    run = open_scene(command.run, "cpu", command.step, command.data)
    if run.lone is not None and command.hub is not None:
        raise InputError(f"expected a run folder for --hub, found {command.run}; make one with `{PROG} import`")
    bakes = command.hub is not None or any(format_named(name).family == GAUSSIANS for name in command.format)
    if bakes:
        reuse_freed()
    line = shlex.join([PROG, "export", *args])
    with ProgressBar(Console(stderr=True, markup=False)) if bakes else nullcontext() as bar:
        tell = bar or (lambda *_: None)
        if command.hub is not None:
            chosen = () if command.format == ExportCommand.format else command.format
            licence = command.licence or hub.UNKNOWN
            written = hub.write_hub(run, command.hub, chosen, command.options, licence=licence, tell=tell, command=line)
        else:
            written = export_several(run, command.format, command.out, command.options, tell=tell, command=line)
    for file in written:
        print("\n".join(file.lines))
    if command.hub is None and "html" in command.format:
        print("next: open the page in a browser; smaller pages, pages of your own, other viewers: docs/how-to.md")
        page = max((file for file in written if file.path.suffix == ".html"), key=lambda file: file.bytes)
        if page.bytes > HEAVY:
            smaller = "--max-gaussians 200000" if page.format == "baked-html" else "--target-mb 20"
            print(f"hint: {page.bytes / 1e6:.0f} MB load slowly for others; {smaller} makes a smaller page")
    if command.hub is not None:
        print(f"wrote {command.hub / hub.CARD}")
        if command.licence is None:
            print("the card says that the licence of the photographs is unknown: --licence mit states it")
    return 0


def import_(args: list[str]) -> int:
    """Make a run folder of a result folder or a file and print where it is."""
    text = f"{docs.of_class(ImportCommand)}\n\n{formats_help(*READ_ONLY)}"
    brought = {"data.normalise": defaults_in(args).normalise}
    command = parse(ImportCommand, Command(f"{PROG} import", ("source",), FIRST, text, brought), args)

    from scene_experts.api.command_line import changes, words_of
    from scene_experts.files.importing import import_files
    from scene_experts.training.run_folder import named, read_config

    asked = named(command.data)
    print(f"wrote {import_files(command.source, asked, command.out, command.iteration, command.transform)}")
    if own := [
        word for place, value in changes(asked, read_config(command.out).data) or [] if place != "path" for word in words_of(place, value)
    ]:
        print(f"read as its training did, by {shlex.join(own)}; give other values to choose otherwise")
    print(f"next: {shlex.join([PROG, 'eval', str(command.out)])}")
    return 0


def formats_help(*others: str) -> str:
    """The list of all formats, and of others, for a help text."""
    return "\n".join(["Formats:", *(line for name in (*format_names(), *others) for line in columns(f"  {name}", about(name)))])
