"""The photographs of a folder: found, looked at, grouped by the camera that took them, copied into a capture."""

from __future__ import annotations

import re
import shutil
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

from PIL import Image

from scene_experts.data.images import probe
from scene_experts.data.match import EXTENSIONS
from scene_experts.errors import InputError
from scene_experts.io import write_atomic

FEWEST = 3  # photographs: fewer than that have no scene in common
ELSEWHERE = (".heic", ".heif", ".dng", ".cr2", ".cr3", ".nef", ".arw")  # photographs that COLMAP and Pillow do not read
_MAKE, _MODEL, _EXIF, _FOCAL, _LENS = 0x010F, 0x0110, 0x8769, 0x920A, 0xA434


@dataclass(frozen=True)
class Photo:
    """A photograph: its name below the folder of photographs, its size in pixels, and what says which camera took it."""

    name: str
    size: tuple[int, int]
    camera: tuple[str, ...] = ()

    @property
    def stored(self) -> str:
        """Its name in the capture: COLMAP's lists of pairs know no blanks."""
        return re.sub(r"\s+", "_", self.name)


def find(folder: Path) -> list[Photo]:
    """The photographs below `folder`, "2.jpg" before "10.jpg". Raises InputError where there are too few or one is not readable."""
    if not folder.is_dir():
        raise InputError(f"expected a folder of photographs or a video at {folder}, found none; correct the path")
    files = [
        path for path in folder.rglob("*") if path.is_file() and not any(part.startswith(".") for part in path.relative_to(folder).parts)
    ]
    photos = sorted(
        (path for path in files if path.suffix.lower() in EXTENSIONS), key=lambda path: natural(path.relative_to(folder).as_posix())
    )
    if len(photos) < FEWEST:
        raw = sorted({path.suffix.lower() for path in files} & set(ELSEWHERE))
        advice = f"save the {', '.join(raw)} files as JPEG" if raw else "take more: tens, each showing most of what the one before shows"
        raise InputError(f"expected at least {FEWEST} photographs ({', '.join(EXTENSIONS)}) in {folder}, found {len(photos)}; {advice}")
    found = [Photo(path.relative_to(folder).as_posix(), probe(path)[0], camera_of(path)) for path in photos]
    for one, other in pairwise(sorted(found, key=lambda photo: photo.stored)):
        if one.stored == other.stored:
            raise InputError(
                f"expected names that differ by more than blanks in {folder}, found '{one.name}' and '{other.name}'; rename one"
            )
    return found


def natural(name: str) -> list[tuple[int, str]]:
    """A key that puts numbers in names in their own order."""
    return [(int(part), "") if part.isdigit() else (-1, part.lower()) for part in re.split(r"(\d+)", name)]


def camera_of(path: Path) -> tuple[str, ...]:
    """Maker, model, lens and focal length that the photograph states, empty where it states none."""
    with Image.open(path) as image:
        try:
            exif = image.getexif()
            inner = exif.get_ifd(_EXIF)
        except (OSError, ValueError, SyntaxError):
            return ()
    said = (exif.get(_MAKE), exif.get(_MODEL), inner.get(_LENS), inner.get(_FOCAL))
    return tuple(str(value).strip() for value in said) if any(said) else ()


def by_camera(photos: Sequence[Photo]) -> list[list[str]]:
    """Stored names by camera: photographs of the same size, maker, model, lens and focal length (a zoom makes another camera)."""
    groups: dict[object, list[str]] = {}
    for photo in photos:
        groups.setdefault((photo.size, photo.camera), []).append(photo.stored)
    return list(groups.values())


def copy(photos: Sequence[Photo], source: Path, target: Path) -> None:
    """Put the photographs into folder `target` under their stored names; those already there, of the same size and time, stay.

    Raises InputError where another file of such a name is there, and where `target` is `source` and a name would change.
    """
    here = source.resolve() == target.resolve()
    for photo in photos:
        old, new = source / photo.name, target / photo.stored
        if here and photo.name != photo.stored:
            raise InputError(f"expected names without blanks in {source}, found '{photo.name}'; rename it, or give another --out")
        if new.exists():
            there, ours = new.stat(), old.stat()
            if (there.st_size, int(there.st_mtime)) != (ours.st_size, int(ours.st_mtime)):
                raise InputError(f"expected {new} to be a copy of {old}, found another file; choose another --out")
            continue
        new.parent.mkdir(parents=True, exist_ok=True)
        write_atomic(new, lambda temporary, old=old: shutil.copy2(old, temporary))
