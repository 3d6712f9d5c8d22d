"""The list of file formats and the list of scene families, by name. Modules are imported when they
are asked for.

A new format is one module with a value `FORMAT` and one line in `FORMATS`; a new family is one
module with a value `FAMILY` and one line in `FAMILIES`. From outside the package, call `register`
or `register_family`, or name the module in the entry point group `scene_experts.formats`. Command
line choices, help texts, file recognition and clean-up follow these lists. See
docs/adding-a-format.md.
"""

from __future__ import annotations

import ast
import re
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import cache
from importlib import import_module
from importlib.machinery import PathFinder
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

from scene_experts.core.errors import InputError, nearest
from scene_experts.core.reading import budget
from scene_experts.core.reading.source import guarding, opening

if TYPE_CHECKING:
    from torch import Tensor

    from scene_experts.data.settings import Data
    from scene_experts.data.views import Capture, Vector, World
    from scene_experts.scene import Scene
    from scene_experts.training.config import Train
    from scene_experts.training.run_folder import OpenRun

FORMATS = {
    "anchors": "scene_experts.files.anchors",
    "compact": "scene_experts.files.anchors.compact",
    "ply": "scene_experts.files.formats.ply",
    "compressed-ply": "scene_experts.files.formats.compressed_ply",
    "splat": "scene_experts.files.formats.splat",
    "spz": "scene_experts.files.formats.spz",
    "sog": "scene_experts.files.formats.sog",
    "glb": "scene_experts.files.formats.glb",
    "usd": "scene_experts.files.formats.usd",
    "mesh": "scene_experts.files.mesh",
    "baked-html": "scene_experts.files.formats.html",
    "html": "scene_experts.files.anchors.live",
    "streamed-html": "scene_experts.files.anchors.streamed",
}
"""Name on the command line -> module that states the format as `FORMAT`."""

READ_ONLY = {
    "ksplat": "scene_experts.files.formats.ksplat",
    "zip": "scene_experts.files.formats.zipped",
}
"""Formats of other programs that are read and not written."""

FAMILIES = {
    "anchors": "scene_experts.files.anchors",
    "gaussians": "scene_experts.files.gaussians",
    "graph": "scene_experts.files.graph",
}
"""Family of a scene (`Traits.family`) -> module that states the family's files as `FAMILY`."""

GAUSSIANS = "gaussians"  # the family whose files hold standard Gaussians; other scenes are baked for them
DRAWN = "drawn"  # of formats that hold what a scene's pictures show, whatever it is made of
ENTRY_POINTS = "scene_experts.formats"
DESCRIPTIONS = ("lod-meta.json", "meta.json")  # of folders of SOG
HEAD = 4096  # bytes that formats are recognised by
_OWN_NAME = re.compile(r"scene(_level\d+)?(\.[^.]+)+")

Note = dict[str, Any]


@dataclass(frozen=True)
class Format:
    """A file format: what it is called, what it can hold, and how it is written, recognised and
    read."""

    suffix: str
    """How file names end, with the dot; empty for the result folder of a family."""
    family: str = GAUSSIANS
    """The scenes that it holds as they are. A format of "gaussians" holds every other scene too,
    baked to standard Gaussians; one of "drawn" what their pictures show."""
    write: Callable[[Path, Any, Note], object] | None = None
    """write(path, contents, note): writes one file atomically. contents: what `Family.contents`
    returns, for "gaussians" a `Splats`. note: how the file was made, as JSON values, for formats
    with room for it. Returns what the terminal says about the file, or None. Raises InputError for
    contents that the format cannot hold and RunError when the disk is full. None: the result folder
    of the family."""
    size: Callable[[Path], int] | None = None
    """size(path): bytes of a file that `write` has made, with those of the files that belong to it.
    None: it is one file."""
    read: Callable[[Path], Any] | None = None
    """read(path): the contents of a file. Raises InputError for a damaged file."""
    marks: tuple[bytes, ...] = ()
    """First bytes of a file; empty for formats without a signature, which are tried last."""
    looks_like: Callable[[Path, bytes], bool] | None = None
    """looks_like(path, first 4096 bytes): a further test, after `marks`. A format with neither is
    never recognised."""
    other_suffixes: tuple[str, ...] = ()
    """Other suffixes that are accepted in --out."""
    sh_degree: int = 3
    """Highest degree of spherical harmonics that a file holds."""
    antialias: bool = False
    """The writer uses the entry `antialias` of the note: whether to draw the Gaussians with
    antialiasing."""
    is_antialiased: Callable[[Path], bool] | None = None
    """is_antialiased(path): whether a file says that it is drawn with antialiasing. None: files do
    not say."""
    read_note: Callable[[Path], Note] | None = None
    """read_note(path): the note that `write` was given, without what had no room in the file; empty
    for files of other programs. None: the format has no room for one."""
    needs: Callable[[], None] | None = None
    """needs(): raises InputError where a library that the writer needs is missing. It is called
    before a scene is baked."""
    view_note: Callable[[Capture, World], Note] | None = None
    """view_note(capture, world): entries about the capture's cameras that the writer adds to the
    note."""
    look: Callable[..., Note] | None = None
    """look(run, capture, world, options, rasterize): entries for the note that take the scene's
    pictures at the cameras of a capture, or its photographs (`photographs`). world: the frame that
    the contents are written in. Raises InputError for photographs that are gone. None: that option
    is refused."""

    fit: Callable[..., tuple[Any, list[str]]] | None = None
    """fit(run, contents, world, options, capture, rasterize, tell): contents as precise as the
    options ask for (`quality`, `target_mb`), and sentences about that for the terminal. world: of
    the run, in the frame of its capture. capture: None where it is gone. None: contents are written
    as they are, and those options are refused."""

    otherwise: str = ""
    """Name of the format that writes in place of this one what this one cannot hold: scenes of other
    families, and those with parts that it `lacks`."""
    lacks: Callable[[Any], str] | None = None
    """lacks(contents): a part of a scene of its family that the format does not know; empty: it
    knows all."""
    draw: Callable[..., tuple[Any, Note]] | None = None
    """draw(run, capture, options, rasterize, tell): the contents of a file of "drawn", in the
    capture's own frame or relative to the `origin` of the note, and how they were made."""

    prepare: Callable[..., str] | None = None
    """prepare(run, capture, rasterize, device): measures at the end of a training what `fit` needs,
    and keeps it in the run folder. Returns a sentence about it."""

    @property
    def is_folder(self) -> bool:
        """Whether it is the result folder of a family and not a file."""
        return not self.suffix


@dataclass(frozen=True)
class Imported:
    """What a file says about a run: everything that a run folder needs."""

    cfg: Train
    data: Data
    """How the capture was read."""
    capture: Capture
    tensors: dict[str, Tensor]
    """By the names of a checkpoint, trained world."""
    meta: dict[str, Any]
    """The values of `Scene.meta`."""
    step: int
    """Iterations trained; 0 where the file does not say."""
    origin: Vector = (0.0, 0.0, 0.0)
    """Place in the capture's own frame that the positions of the file are relative to."""


class Family(Protocol):
    """The files of one family of scenes. Contents are what the family's formats write and read, in
    the capture's own frame."""

    def describe(self, run: OpenRun, world: World) -> dict[str, Any]:
        """What the tensors of a run's files do not say, as JSON values. With the recipe and the
        reading of the capture, this is the description (scene.json) beside a scene."""
        ...

    def contents(self, run: OpenRun, world: World, about: dict[str, Any]) -> Any:
        """The scene of a run in the capture's own frame, for `Format.write`. about: its
        description, for contents that keep one."""
        ...

    def write(self, run: OpenRun, world: World, folder: Path, about: dict[str, Any]) -> dict[str, Any]:
        """Write the scene into `folder` (point_cloud/iteration_N of a result folder); about: the
        description.

        Returns the settings for cfg_args, which readers of the 3DGS family look up; empty for none.
        Raises RunError when the disk is full.
        """
        ...

    def warnings(self, run: OpenRun) -> list[str]:
        """What other readers of the result folder get wrong about this run."""
        ...

    def find(self, source: Path, iteration: int | None) -> Path | None:
        """The part of the result folder `source` that `read` takes; None where the folder holds
        another family."""
        ...

    def read(self, source: Path, data: Data | None, iteration: int | None) -> Imported:
        """The run in `source`: what `find` returned, or a file of one of the family's formats.
        data: the capture that it belongs to; None: it is not here, and `placed.place_cameras` makes
        one without photographs.

        Raises InputError for damaged files and for a capture that does not fit.
        """
        ...

    def scene(self, run: OpenRun, contents: Any, world: World) -> tuple[Scene, int]:
        """The scene that contents hold, in the run's world and with the run's configuration, and
        the step to draw it at."""
        ...


def register(name: str, module: str) -> None:
    """Add a format: `module` is the import path of a module that states it as `FORMAT`."""
    FORMATS[name] = module


def register_family(name: str, module: str) -> None:
    """Add the files of a scene family (`Traits.family`): `module` states them as `FAMILY`."""
    FAMILIES[name] = module


@cache
def _installed() -> dict[str, str]:
    """Formats of installed packages, by the entry point group."""
    from importlib.metadata import entry_points  # takes longer to import than the rest of this module

    return {point.name: point.module for point in entry_points(group=ENTRY_POINTS)}


def format_names() -> tuple[str, ...]:
    """The names of all formats, as on the command line."""
    return tuple(_installed() | FORMATS)


def format_named(name: str) -> Format:
    """A format by its name on the command line. Raises InputError for an unknown name."""
    return import_module(_module(name)).FORMAT


def _module(name: str) -> str:
    module = FORMATS.get(name) or _installed().get(name)
    if module is None:
        names = format_names()
        raise InputError(f"expected a format among {', '.join(names)}, found '{name}'{nearest(name, names) or '; choose one of them'}")
    return module


def about(name: str) -> str:
    """What a format is, in one sentence: the first of its module's docstring, read without
    importing the module."""
    root, *below = (READ_ONLY.get(name) or _module(name)).split(".")
    spec = find_spec(root)
    for part in below:  # `find_spec` of the whole name would import the packages above the module
        spec = spec and PathFinder.find_spec(f"{spec.name}.{part}", spec.submodule_search_locations)
    read_source = getattr(spec.loader, "get_source", None) if spec is not None else None  # the loader of an editable install has it too
    source = read_source(spec.name) if spec is not None and read_source is not None else None
    text = ast.get_docstring(ast.parse(source)) if source else None
    return " ".join((text or "").partition("\n\n")[0].split())


def family_named(name: str) -> Family | None:
    """The files of a scene family; None where the family has none of its own."""
    return import_module(FAMILIES[name]).FAMILY if name in FAMILIES else None


def formats_of(family: str, names: Iterable[str] | None = None) -> dict[str, Format]:
    """The file formats that hold scenes of `family` as they are, by name."""
    found = {name: format_named(name) for name in names or format_names()}
    return {name: format for name, format in found.items() if format.family == family}


def scene_file(path: Path) -> Path:
    """The file of the scene at `path`: the description in a folder of SOG, else `path` itself."""
    if path.is_dir():
        return next((path / name for name in DESCRIPTIONS if (path / name).is_file()), path)
    return path


def recognise(path: Path) -> tuple[str, Format]:
    """The format of a file, by its first bytes; formats without a signature by whatever they look
    at, last.

    Raises InputError for a missing file and for one of no known format.
    """
    with opening(path, budget.HEAD) as source:
        head = source.head(HEAD)
    found = {name: format_named(name) for name in format_names()} | {name: import_module(at).FORMAT for name, at in READ_ONLY.items()}
    for name, format in sorted(found.items(), key=lambda item: not item[1].marks):  # stable: signatures first
        if format.read is None or not (format.marks or format.looks_like):
            continue
        if (not format.marks or head.startswith(format.marks)) and (format.looks_like is None or format.looks_like(path, head)):
            return name, format
    readable = ", ".join(name for name, format in found.items() if format.read is not None)
    raise InputError(f"expected a file of a known format ({readable}) at {path}, found something else; give another file")


def read(path: Path) -> Any:
    """The contents of a file of any format that has a reader, or of a folder of SOG. Raises
    InputError for others and for damaged files."""
    path = scene_file(Path(path))
    format = recognise(path)[1]
    assert format.read is not None
    with guarding(path, budget.HEAD):  # a format of another package may raise anything
        return format.read(path)


def exported_files(folder: Path) -> list[Path]:
    """The files in `folder` that `export` wrote under its own names (scene.SUFFIX,
    scene_levelN.SUFFIX), with their descriptions."""
    named = [path for path in sorted(folder.glob("scene*")) if path.is_file() and _OWN_NAME.fullmatch(path.name)]
    if not named:
        return []
    parts = sorted(folder.glob("scene.parts/*-*.bin"))  # of a streamed page
    suffixes = {format_named(name).suffix for name in format_names()} - {""}
    return parts + [path for path in named if path.name.removesuffix(".json")[path.name.index(".") :] in suffixes]
