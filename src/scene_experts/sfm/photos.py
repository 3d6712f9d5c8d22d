"""The photographs of a folder: found, looked at, grouped by the camera that took them, copied into a capture."""

from __future__ import annotations

import re
import shutil
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

from PIL import Image, ImageOps

from scene_experts.data.images import probe
from scene_experts.data.match import EXTENSIONS
from scene_experts.errors import InputError
from scene_experts.io import write_atomic

FEWEST = 3  # photographs: fewer than that have no scene in common
ELSEWHERE = (".heic", ".heif", ".dng", ".cr2", ".cr3", ".nef", ".arw")  # photographs that COLMAP and Pillow do not read
_MAKE, _MODEL, _ORIENTATION, _EXIF, _FOCAL, _LENS = 0x010F, 0x0110, 0x0112, 0x8769, 0x920A, 0xA434


@dataclass(frozen=True)
class Photo:
    """A photograph: its name below its folder, its stored size in pixels, what says which camera took it, and its EXIF orientation."""

    name: str
    size: tuple[int, int]
    camera: tuple[str, ...] = ()
    orientation: int = 1

    @property
    def stored(self) -> str:
        """Its name in the capture: COLMAP's lists of pairs know no blanks."""
        return re.sub(r"\s+", "_", self.name)

    @property
    def upright(self) -> Photo:
        """As it is in the capture: under its stored name, turned as it is to be looked at."""
        size = (self.size[1], self.size[0]) if self.orientation in (5, 6, 7, 8) else self.size
        return Photo(self.stored, size, self.camera)


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
    found = [Photo(path.relative_to(folder).as_posix(), probe(path)[0], *said(path)) for path in photos]
    for one, other in pairwise(sorted(found, key=lambda photo: photo.stored)):
        if one.stored == other.stored:
            raise InputError(
                f"expected names that differ by more than blanks in {folder}, found '{one.name}' and '{other.name}'; rename one"
            )
    return found


def natural(name: str) -> list[tuple[int, str]]:
    """A key that puts numbers in names in their own order."""
    return [(int(part), "") if part.isdecimal() else (-1, part.lower()) for part in re.split(r"(\d+)", name)]


def said(path: Path) -> tuple[tuple[str, ...], int]:
    """What a photograph states: maker, model, lens and focal length (empty where it states none), and its orientation (1 to 8)."""
    with Image.open(path) as image:
        try:
            exif = image.getexif()
            inner = exif.get_ifd(_EXIF)
        except (OSError, ValueError, SyntaxError):
            return (), 1
    camera = (exif.get(_MAKE), exif.get(_MODEL), inner.get(_LENS), inner.get(_FOCAL))
    turned = exif.get(_ORIENTATION, 1)
    return tuple(str(value).strip() for value in camera) if any(camera) else (), turned if turned in range(1, 9) else 1


def by_camera(photos: Sequence[Photo]) -> list[list[str]]:
    """Names by camera: photographs of the same size, maker, model, lens and focal length (a zoom makes another camera)."""
    groups: dict[object, list[str]] = {}
    for photo in photos:
        groups.setdefault((photo.size, photo.camera), []).append(photo.name)
    return list(groups.values())


def copy(photos: Sequence[Photo], source: Path, target: Path) -> list[Photo]:
    """Put the photographs into folder `target` under their stored names, those that EXIF turns upright; returns them as they are there.

    COLMAP takes the stored pixels, and a scene of sideways photographs would lie on its side. Photographs that are there already, of the
    same time and, unless turned, the same size, stay. With `target` = `source` all stay as they are.
    Raises InputError where another file of such a name is there, and where `target` is `source` and a name would change.
    """
    if source.resolve() == target.resolve():
        if blank := next((photo.name for photo in photos if photo.name != photo.stored), None):
            raise InputError(f"expected names without blanks in {source}, found '{blank}'; rename it, or give another --out")
        return list(photos)
    for photo in photos:
        old, new = source / photo.name, target / photo.stored
        if new.exists():
            there, ours = new.stat(), old.stat()
            if int(there.st_mtime) != int(ours.st_mtime) or (photo.orientation == 1 and there.st_size != ours.st_size):
                raise InputError(f"expected {new} to be a copy of {old}, found another file; choose another --out")
            continue
        new.parent.mkdir(parents=True, exist_ok=True)
        write_atomic(new, lambda temporary, old=old, turned=photo.orientation != 1: transfer(old, temporary, turned))
    return [photo.upright for photo in photos]


def transfer(old: Path, new: Path, turned: bool) -> None:
    """Copy a photograph with its time; a turned one is written anew, with hardly a loss, its EXIF block without the orientation."""
    if not turned:
        shutil.copy2(old, new)
        return
    with Image.open(old) as image:
        upright = ImageOps.exif_transpose(image)
        options = {"quality": 96, "subsampling": 0} if image.format == "JPEG" else {}
        upright.save(new, image.format, exif=upright.getexif(), **options)
    shutil.copystat(old, new)
