"""The photographs of a folder: found, looked at, grouped by the camera that took them, made ready for COLMAP."""

from __future__ import annotations

import os
import re
import shutil
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path, PurePosixPath

from PIL import Image, ImageOps

from scene_experts.core.errors import InputError
from scene_experts.core.io import read_json, write_atomic, write_json
from scene_experts.data.images import to_8_bit
from scene_experts.data.match import EXTENSIONS

FEWEST = 3  # photographs: fewer than that have no scene in common
ELSEWHERE = (".heic", ".heif", ".dng", ".cr2", ".cr3", ".nef", ".arw")  # photographs that Pillow does not read
PLAIN = ("JPEG", "MPO", "PNG", "BMP", "TIFF")  # what COLMAP reads
MASKS = (".mask.png", "_mask.png")  # behind the stem of a photograph beside them
COPIED = "copied.json"
_MAKE, _MODEL, _ORIENTATION, _EXIF, _FOCAL, _LENS = 0x010F, 0x0110, 0x0112, 0x8769, 0x920A, 0xA434


@dataclass(frozen=True)
class Photo:
    """A photograph: its name below its folder, its size in pixels, what says which camera took it.

    orientation: EXIF's, 1 to 8.  suffix: of the file it must be written as, because COLMAP does not read the one it is; "" where it does.
    stamp: bytes and time of the file, and of its mask.  mask: the name of the file that says which pixels count, where one lies beside it.
    """

    name: str
    size: tuple[int, int]
    camera: tuple[str, ...] = ()
    orientation: int = 1
    suffix: str = ""
    stamp: tuple[int, ...] = (0, 0)
    mask: str = ""

    @property
    def stored(self) -> str:
        """Its name in the capture: in COLMAP's lists of pairs blanks divide names, and a first # begins a comment."""
        name = re.sub(r"\s+", "_", self.name)
        name = "_" + name[1:] if name.startswith("#") else name
        return str(PurePosixPath(name).with_suffix(self.suffix)) if self.suffix else name

    @property
    def upright(self) -> Photo:
        """As it is in the capture: under its stored name, turned as it is to be looked at."""
        size = (self.size[1], self.size[0]) if self.orientation in (5, 6, 7, 8) else self.size
        return Photo(self.stored, size, self.camera, stamp=self.stamp)


def find(folder: Path, but: Path | None = None) -> list[Photo]:
    """The photographs below `folder` and not below `but`, "2.jpg" before "10.jpg". Every one is decoded, at an eighth of its size.

    Raises InputError where there are too few, or one is not whole or has a name that cannot be kept.
    """
    files = below(folder, but)
    names = sorted((path.relative_to(folder).as_posix() for path in files if path.suffix.lower() in EXTENSIONS), key=natural)
    masks = masks_of(names)
    names = [name for name in names if name not in masks.values()]
    if len(names) < FEWEST:
        raw = sorted({path.suffix.lower() for path in files} & set(ELSEWHERE))
        advice = f"save the {', '.join(raw)} files as JPEG" if raw else "take more: tens, each showing most of what the one before shows"
        raise InputError(f"expected at least {FEWEST} photographs ({', '.join(EXTENSIONS)}) in {folder}, found {len(names)}; {advice}")
    found = [look(folder, name, masks.get(name, "")) for name in names]
    for one, other in pairwise(sorted(found, key=lambda photo: photo.stored)):
        if one.stored == other.stored:
            raise InputError(
                f"expected names that differ by more than blanks or kind in {folder}, found '{one.name}' and '{other.name}'; rename one"
            )
    return found


def below(folder: Path, but: Path | None) -> list[Path]:
    """The files below `folder`, links followed, hidden ones and those below `but` left out."""
    out, seen = [], set()
    for place, folders, files in os.walk(folder, followlinks=True):
        here = Path(place).resolve()
        folders[:] = [name for name in folders if not name.startswith(".")]
        if here in seen or (but is not None and here == but.resolve() and here != folder.resolve()):
            folders.clear()
            continue
        seen.add(here)
        out += [path for name in files if not name.startswith(".") and (path := Path(place) / name).is_file()]
    return out


def natural(name: str) -> list[tuple[int, str]]:
    """A key that puts numbers in names in their own order."""
    return [(int(part), "") if part.isdecimal() else (-1, part.lower()) for part in re.split(r"(\d+)", name)]


def masks_of(names: Sequence[str]) -> dict[str, str]:
    """Masks that lie beside photographs, by the name of the photograph."""
    there = set(names)
    stems = ((name, str(PurePosixPath(name).with_suffix(""))) for name in names)
    return {name: f"{stem}{ending}" for name, stem in stems for ending in MASKS if f"{stem}{ending}" in there}


def look(folder: Path, name: str, mask: str) -> Photo:
    """What a photograph is and states. Raises InputError where it is not whole."""
    path = folder / name
    try:
        name.encode()
    except UnicodeEncodeError:
        raise InputError(f"expected names in UTF-8 in {folder}, found {name!r}; rename the file") from None
    try:
        with Image.open(path) as image:
            size, plain, png = image.size, image.format in PLAIN and not deep(image), "A" in image.getbands() or deep(image)
            exif = image.getexif()
            inner = exif.get_ifd(_EXIF)
            image.draft(None, (max(1, size[0] // 8), max(1, size[1] // 8)))
            image.load()
    except (OSError, ValueError, SyntaxError, Image.DecompressionBombError) as error:
        raise InputError(f"expected a whole photograph at {path}, found one that is not ({error}); replace it or take it away") from error
    stated = (exif.get(_MAKE), exif.get(_MODEL), inner.get(_LENS), inner.get(_FOCAL))
    turned = exif.get(_ORIENTATION, 1)
    return Photo(
        name,
        size,
        tuple(str(value).strip() for value in stated) if any(stated) else (),
        turned if turned in range(1, 9) else 1,
        "" if plain else ".png" if png else ".jpg",
        stamp(path) + (stamp(folder / mask) if mask else ()),
        mask,
    )


def deep(image: Image.Image) -> bool:
    """Whether a picture is grey of more than 8 bits, which COLMAP does not read."""
    return image.mode.startswith("I") or image.mode == "F"


def stamp(path: Path) -> tuple[int, int]:
    """Bytes and time of a file."""
    return path.stat().st_size, path.stat().st_mtime_ns


def by_camera(photos: Sequence[Photo]) -> list[list[str]]:
    """Names by camera: photographs of the same size, maker, model, lens and focal length (a zoom makes another camera)."""
    groups: dict[object, list[str]] = {}
    for photo in photos:
        groups.setdefault((photo.size, photo.camera), []).append(photo.name)
    return list(groups.values())


def in_place(photos: Sequence[Photo], folder: Path) -> list[Photo]:
    """The photographs of a capture's own folder of images, which stay as they are. Raises InputError where COLMAP cannot take one so."""
    if other := next((photo for photo in photos if photo.name != photo.stored), None):
        raise InputError(f"expected photographs as COLMAP takes them in {folder}, found '{other.name}'; make a new capture of them (--out)")
    return list(photos)


def copy(photos: Sequence[Photo], source: Path, target: Path) -> list[Photo]:
    """Make folder `target` hold the photographs under their stored names and nothing else; returns them as they are there.

    Those that EXIF turns are written upright, with hardly a loss: COLMAP takes the stored pixels, and a scene of sideways photographs would
    lie on its side. Copies that are there already stay.
    """
    note = target.with_name(COPIED)
    kept: dict[str, list[int]] = read_json(note, "list of copies") if note.is_file() else {}
    wanted = {photo.stored: photo for photo in photos}
    masks = {str(target / stem(photo)) + ending(photo.mask) for photo in photos if photo.mask}
    for path in [path for path in target.rglob("*") if path.is_file()]:
        if path.relative_to(target).as_posix() not in wanted and str(path) not in masks:
            path.unlink()
    for name, photo in wanted.items():
        new = target / name
        if not new.is_file() or tuple(kept.get(name, ())) != photo.stamp:
            transfer(source / photo.name, new, photo.orientation, photo.suffix)
            if photo.mask:
                transfer(source / photo.mask, Path(f"{target / stem(photo)}{ending(photo.mask)}"), photo.orientation)
            kept[name] = list(photo.stamp)
    write_json(note, {name: stamp for name, stamp in kept.items() if name in wanted})
    return [photo.upright for photo in photos]


def stem(photo: Photo) -> str:
    return str(PurePosixPath(photo.stored).with_suffix(""))


def ending(mask: str) -> str:
    return next(end for end in MASKS if mask.endswith(end))


def transfer(old: Path, new: Path, orientation: int, suffix: str = "") -> None:
    """Copy a photograph, or write it anew: turned upright, or as another kind of file (`suffix`)."""
    new.parent.mkdir(parents=True, exist_ok=True)
    if orientation == 1 and not suffix:
        write_atomic(new, lambda temporary: shutil.copyfile(old, temporary))
        return
    with Image.open(old) as image:
        form = {".jpg": "JPEG", ".png": "PNG"}.get(suffix) or ("JPEG" if image.format == "MPO" else image.format)
        image.getexif()[_ORIENTATION] = orientation  # that of the photograph, for its mask too
        upright = ImageOps.exif_transpose(image)
        exif, upright = upright.getexif(), to_8_bit(upright) if deep(upright) else upright
    if form == "JPEG":
        upright = upright if upright.mode in ("L", "RGB", "CMYK") else upright.convert("RGB")
        options = {"quality": 96, "subsampling": 0}
    else:
        options = {}
    write_atomic(new, lambda temporary: upright.save(temporary, form, exif=exif, **options))
