"""The readers of captures. A new kind is one file in this folder and one line in READERS.

A reader outside this package is added with `register`, or by an entry point of the group
"scene_experts.readers".
"""

from __future__ import annotations

import functools
import importlib
import shlex
from importlib.metadata import entry_points
from pathlib import Path

from scene_experts.core.errors import InputError
from scene_experts.data.match import EXTENSIONS
from scene_experts.data.readers.reader import PosedImage, RawCapture, Reader, ReadOptions

__all__ = [
    "READERS",
    "PosedImage",
    "RawCapture",
    "ReadOptions",
    "Reader",
    "choose_reader",
    "find_reader",
    "is_capture",
    "register",
    "tell_others",
    "unrecognised_error",
]

GROUP = "scene_experts.readers"
READERS = (  # module:object, imported on first use; the first reader that recognises a folder reads it
    "scene_experts.data.readers.colmap:READER",
    "scene_experts.data.readers.blender:READER",
    "scene_experts.data.readers.nerfstudio:READER",
    "scene_experts.data.readers.realitycapture:READER",
    "scene_experts.data.readers.metashape:READER",
    "scene_experts.data.readers.bundler:READER",
    "scene_experts.data.readers.polycam:READER",
)
_BY_SUFFIX = {".json": "nerfstudio", ".csv": "realitycapture", ".xml": "metashape", ".out": "bundler"}
_registered: list[Reader] = []


def register(reader: Reader) -> None:
    """Add a reader. It is asked before the built-in readers, and before readers registered
    earlier."""
    _registered.insert(0, reader)


@functools.cache
def _load_built_in() -> tuple[Reader, ...]:
    places = (place.partition(":") for place in READERS)
    return tuple(getattr(importlib.import_module(module), name) for module, _, name in places)


@functools.cache
def _load_installed() -> tuple[Reader, ...]:
    """Load the readers that installed packages offer. Raises InputError if one cannot be
    imported."""
    found = []
    for entry in entry_points(group=GROUP):
        try:
            found.append(entry.load())
        except Exception as error:
            raise InputError(f"cannot import the capture reader {entry.name} ({entry.value}): {error}; fix or uninstall it") from error
    return tuple(found)


def find_reader(folder: Path) -> Reader | None:
    """Return the reader that recognises `folder`, or None."""
    for readers in (_registered, _load_built_in(), _load_installed()):
        for reader in readers:
            if reader.recognise(folder):
                return reader
    return None


def choose_reader(folder: Path, model: Path | None) -> Reader | None:
    """Return the reader of `model`, a reconstruction or a file of poses in `folder`; without it,
    that which recognises `folder`, or None. Raises InputError if nothing reads `model`."""
    if model is None:
        return find_reader(folder)
    kind = "colmap" if model.is_dir() else _BY_SUFFIX.get(model.suffix.lower())
    reader = next((reader for reader in _load_built_in() if reader.name == kind), None)
    if reader is None or not model.exists():
        raise InputError(
            f"expected a folder such as sparse/1, or a file of poses ({', '.join(_BY_SUFFIX)}), in {folder} for --model, "
            f"found {model.name if model.exists() else 'nothing'} at {model}; correct --model"
        )
    return reader


def tell_others(folder: Path, reader: Reader) -> list[str]:
    """Return a warning if `folder` also holds a capture of a kind that a later built-in reader
    reads."""
    built_in = _load_built_in()
    later = built_in[built_in.index(reader) + 1 :] if reader in built_in else ()
    return [
        f"the folder is read as {reader.files}, and also holds {other.files}; choose a file of poses with --model, or move the files "
        f"of the first away, to read the second"
        for other in later
        if other.recognise(folder)
    ][:1]


def is_capture(folder: Path) -> bool:
    """Return whether a reader recognises `folder`."""
    return find_reader(folder) is not None


def unrecognised_error(folder: Path) -> InputError:
    """Return the error for a folder that no reader recognises. It says what to do, e.g. with
    photographs without camera poses."""
    kinds = ", ".join(reader.files for reader in (*_load_built_in(), *_load_installed(), *_registered))
    expected = f"expected a capture in {folder} ({kinds}), found"
    if is_capture(folder.absolute().parent):
        return InputError(f"{expected} a part of one; give the folder that contains it: {folder.absolute().parent}")
    for place in (folder, folder / "images"):
        photos = sum(p.suffix.lower() in EXTENSIONS for p in place.iterdir()) if place.is_dir() else 0
        if photos:
            words = ["scene-experts", "capture", str(place), "--out", "CAPTURE" if place == folder else str(folder)]
            return InputError(f"expected camera poses in {folder}, found only {photos} photographs; run `{shlex.join(words)}`")
    if (folder / ".capture").is_dir():
        return InputError(f"{expected} an unfinished one; run its `scene-experts capture PHOTOS --out {shlex.quote(str(folder))}` again")
    return InputError(f"{expected} none of these; give the folder that contains them")
