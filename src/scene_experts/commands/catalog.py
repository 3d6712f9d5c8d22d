"""`scene-experts download` and `catalog`: the scenes of the paper."""

from __future__ import annotations

import shlex
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from rich.console import Console
from rich.progress import BarColumn, DownloadColumn, Progress, TaskID, TextColumn, TimeRemainingColumn, TransferSpeedColumn
from rich.table import Table

from scene_experts.arguments.option import Option
from scene_experts.arguments.parse import Command, parse
from scene_experts.commands import PROG
from scene_experts.core.errors import InputError
from scene_experts.data.fetch.catalog import COLLECTIONS, SCENES, CatalogScene, select
from scene_experts.data.fetch.obtain import captures_dir, is_present, obtain

SAY_EVERY = 15.0  # seconds between lines, without a terminal


@dataclass(frozen=True)
class DownloadCommand:
    """Download scenes of the paper from their owners, verify and unpack them. Repeat the command to
    continue a download."""

    scenes: Annotated[tuple[str, ...], Option(value="SCENE")] = ()
    """Scenes (such as bonsai), data sets (mipnerf360, tandt, db, bungeenerf) or all. The archive of
    a data set is downloaded once, as a whole."""
    to: Path | None = None
    """Folder for the scenes; by default $SCENE_EXPERTS_CAPTURES, or the cache folder of the
    user."""
    mirror: Annotated[tuple[str, ...], Option(value="URL", repeat=True)] = ()
    """Address of a folder with the archives, tried before those of the owners. Can be repeated."""
    keep_archives: bool = True
    """Keep the downloaded archives for their other scenes."""
    list: bool = False
    """List the scenes and download nothing."""


def download(args: list[str]) -> int:
    command = parse(DownloadCommand, Command(f"{PROG} download", ("scenes",)), args)
    root = command.to or captures_dir()
    console = Console(markup=False, highlight=False, soft_wrap=True)
    scenes = select(command.scenes)
    if command.list:
        console.print(table(scenes or SCENES, root))
        return 0
    if not scenes:
        raise InputError(f"expected SCENE, found none; name scenes to download (`{PROG} catalog` lists them)")
    with DownloadBar(console) as bar:
        obtain(scenes, root, mirrors=command.mirror, keep=command.keep_archives, say=bar.say, progress=bar)
    for scene in scenes:
        console.print(f"next: {PROG} train moe-gs {flags(scene, command.to)} --out RUN", markup=False)
    return 0


def flags(scene: CatalogScene, to: Path | None) -> str:
    """The options of `train` that follow the paper's protocol for a scene."""
    if to is None:
        return f"--data catalog:{scene.name}"
    from scene_experts.training.config import Train, flags_of

    numbers = shlex.join(flags_of(Train(""), scene.collection.numbers))
    return f"--data {shlex.quote(str(to / scene.path))} --resolution {scene.resolution} --split {scene.split} --normalise none {numbers}"


@dataclass(frozen=True)
class CatalogCommand:
    """List the paper's scenes: sources, sizes, licences, evaluation protocol, and which are on this
    machine."""

    scenes: Annotated[tuple[str, ...], Option(value="SCENE")] = ()
    """Scenes or data sets to describe in detail; by default a table of all."""
    to: Path | None = None
    """Folder of the scenes, as for `download`."""


def catalog(args: list[str]) -> int:
    command = parse(CatalogCommand, Command(f"{PROG} catalog", ("scenes",)), args)
    root, console = command.to or captures_dir(), Console(markup=False, highlight=False, soft_wrap=True)
    scenes = select(command.scenes)
    if not scenes:
        console.print(table(SCENES, root))
        for one in COLLECTIONS:
            console.print(f"{one.key}: {one.archive.name} ({one.archive.size}); licence: {one.licence}", markup=False)
        console.print(f"folder of the scenes: {root}", markup=False)
    for scene in scenes:
        for line in describe(scene, root):
            console.print(line, markup=False)
    return 0


def table(scenes: tuple[CatalogScene, ...] | list[CatalogScene], root: Path) -> Table:
    """A table with a row per scene."""
    out = Table(box=None, pad_edge=False)
    for name in ("scene", "data set", "archive", "views", "resolution", "split", "here"):
        least = max(len(s.name) for s in scenes) if name == "scene" else None  # the words that one has to type are never cut
        out.add_column(name, no_wrap=name in ("scene", "views"), overflow="fold", min_width=least)
    for s in scenes:
        views = "" if s.views is None else str(s.views)
        here = "yes" if is_present(root, s) else ""
        out.add_row(s.name, s.collection.title, s.collection.archive.name, views, s.resolution, s.split, here)
    return out


def describe(scene: CatalogScene, root: Path) -> list[str]:
    """The lines that describe a scene, with the steps to download it by hand."""
    from scene_experts.core.fields import flag_of

    c, a = scene.collection, scene.collection.archive
    numbers = " ".join(f"{flag_of(place)} {value}" for place, value in c.numbers)
    lines = [
        f"{scene.name}: {c.title} ({c.source})",
        f"  licence     {c.licence}",
        f"  archive     {a.name}, {a.size}, from {a.page}" + (f" ({a.notes})" if a.notes else ""),
        *(f"  address     {url}" for url in a.urls),
        f"  SHA-256     {a.sha256 or 'not published; later downloads are compared with the first'}",
        f"  inside      {' or '.join(scene.inside)}",
        f"  protocol    --resolution {scene.resolution} --split {scene.split}" + (f"; others use {scene.also}" if scene.also else ""),
        f"              --normalise none, and {numbers} for recipes with these options",
        f"  views       {scene.views or 'unknown'}",
        f"  folder      {root / scene.path}" + (" (downloaded)" if is_present(root, scene) else " (not downloaded)"),
    ]
    if not is_present(root, scene):
        lines.append(f"  by hand     save {a.name} as {root / 'archives' / a.name} and run `{PROG} download {scene.name}`,")
        lines.append(f"              or copy the scene's images and sparse/0 to {root / scene.path}")
    return lines


class DownloadBar:
    """Shows the progress of a download: a bar on a terminal, otherwise a line every SAY_EVERY
    seconds."""

    console: Console
    last: float
    bar: Progress | None
    task: TaskID | None

    def __init__(self, console: Console) -> None:
        self.console, self.last = console, time.monotonic()
        columns = (TextColumn("{task.description}"), BarColumn(), DownloadColumn(), TransferSpeedColumn(), TimeRemainingColumn())
        self.bar = Progress(*columns, console=console, transient=True) if console.is_terminal else None
        self.task = self.bar.add_task("", total=None) if self.bar else None

    def __enter__(self) -> DownloadBar:
        if self.bar:
            self.bar.start()
        return self

    def __exit__(self, *_: object) -> None:
        if self.bar:
            self.bar.stop()

    def say(self, text: str) -> None:
        self.console.print(text, markup=False)

    def __call__(self, what: str, done: int, total: int) -> None:
        if self.bar and self.task is not None:
            self.bar.update(self.task, description=what, completed=done, total=total or None)
        elif time.monotonic() - self.last > SAY_EVERY:
            self.last = time.monotonic()
            self.say(f"{what}: {done / 1e6:,.0f} of {f'{total / 1e6:,.0f}' if total else '?'} MB")
