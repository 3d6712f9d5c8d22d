"""Finds and inspects the photographs of a folder, groups them by camera, and copies them in a form
that COLMAP reads."""

from __future__ import annotations

import os
import re
import shutil
from collections import Counter
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path, PurePosixPath

import numpy as np
from PIL import Image, ImageOps

from scene_experts.core.errors import InputError, few
from scene_experts.core.extras import install_line
from scene_experts.core.io import read_json, write_atomic, write_json
from scene_experts.core.reading.budget import CAPTURED
from scene_experts.core.reading.deep_colors import COLOR16, describe_mode
from scene_experts.core.reading.pictures import opening_picture
from scene_experts.data.colour import White, find_white, is_deep, lift, to_8_bit
from scene_experts.data.equirectangular import is_seamless
from scene_experts.data.masks import Found, Mask, find_masks, may_be_mask, read_mask
from scene_experts.data.match import EXTENSIONS
from scene_experts.sfm.folders import list_files, tell_written

FEWEST = 3  # photographs needed for a reconstruction
UNSUPPORTED = (".dng", ".cr2", ".cr3", ".nef", ".arw", ".hdr")  # photographs that Pillow does not read
HEIC = (".heic", ".heif")  # read with pillow-heif, if it is installed
COLMAP_FORMATS = ("JPEG", "MPO", "PNG", "BMP", "TIFF")  # what COLMAP reads
_SMALLEST_ROUND = 512  # px; width of a panorama whose edges are looked at
_LONGEST_FACT = 256  # characters of what EXIF says about a camera
COPIED = "copied.json"
_MAKE, _MODEL, ORIENTATION, _EXIF, _FOCAL, _LENS = 0x010F, 0x0110, 0x0112, 0x8769, 0x920A, 0xA434


@dataclass(frozen=True)
class Photo:
    """A photograph: its name, its size and what identifies its camera."""

    name: str  # relative to its folder
    size: tuple[int, int]  # px, as stored
    camera: tuple[str, ...] = ()  # maker, model, lens and focal length from EXIF
    orientation: int = 1  # from EXIF, 1 to 8
    suffix: str = ""  # extension to convert the file to because COLMAP does not read it; "": no conversion
    stamp: tuple[float, ...] = (0, 0)  # bytes and modification time of the file, then of its mask, and how both are read
    mask: Mask | None = None
    mode: str = "RGB"  # of `describe_mode`
    white: White = White()  # of deep photographs
    round: bool = False  # a 360 degree panorama, by its XMP data or by its shape and edges

    @property
    def stored(self) -> str:
        """Its name in the capture. COLMAP's lists of pairs allow neither blanks nor a leading
        "#"."""
        name = re.sub(r"\s+", "_", self.name)
        name = "_" + name[1:] if name.startswith("#") else name
        return str(PurePosixPath(name).with_suffix(self.suffix)) if self.suffix else name

    @property
    def upright(self) -> Photo:
        """The photograph as it is copied into a capture: under its stored name and rotated
        upright."""
        size = (self.size[1], self.size[0]) if self.orientation in (5, 6, 7, 8) else self.size
        return Photo(self.stored, size, self.camera, stamp=self.stamp)


def find_photos(folder: Path, exclude: Path | None = None, say: Callable[[str], None] = lambda _: None) -> list[Photo]:
    """Return the photographs in `folder` and its subfolders except `exclude` and folders with results
    (`folders.holds_results`), sorted so that "2.jpg" precedes "10.jpg".

    Every photograph is decoded at an eighth of its size to verify it. A HEIC file beside a
    photograph of the same name is left out, and so are masks (`data.masks`).

    say: Called with what was found beside photographs.

    Raises InputError if there are too few, if some are damaged or a name cannot be used, or if HEIC
    files cannot be read.
    """
    written = list[Path]()
    files = list_files(folder, exclude, written)
    if written:  # before there may be too few
        say(tell_written(written, folder))
    paths = [path for path in files if path.suffix.lower() in EXTENSIONS]
    paths += find_heic(files, {path.with_suffix("") for path in paths}, folder)
    every = {path.relative_to(folder).as_posix(): path for path in paths}
    found = find_masks({name: path for name, path in every.items() if not may_be_mask(name)}, [folder], [folder.parent])
    names = sorted((name for name, path in every.items() if path not in found.files), key=natural_key)
    if len(names) < FEWEST:
        raw = sorted({path.suffix.lower() for path in files} & set(UNSUPPORTED))
        advice = f"save the {', '.join(raw)} files as JPEG" if raw else "take dozens that overlap strongly"
        raise InputError(f"expected at least {FEWEST} photographs ({', '.join(EXTENSIONS)}) in {folder}, found {len(names)}; {advice}")
    for line in describe_rest(found, names, sorted(set(files) - set(paths)), folder):
        say(line)
    photos = decide_round(inspect_photos(folder, names, found))
    white, notes = find_white([(folder / photo.name, photo.mode) for photo in photos])
    for line in notes:
        say(f"warning: {line}")
    photos = [
        replace(photo, white=white, stamp=(*photo.stamp, white.integer, white.real))
        if is_deep(photo.mode)
        else replace(photo, white=white, suffix=".png", stamp=(*photo.stamp, white.color))
        if photo.mode.endswith(COLOR16) and white.color != White.color
        else photo
        for photo in photos
    ]
    for one, other in pairwise(sorted(photos, key=lambda photo: photo.stored)):
        if one.stored == other.stored:
            raise InputError(
                f"expected names in {folder} that differ not only in blanks or extension, found '{one.name}' and '{other.name}'; rename one"
            )
    return photos


def decide_round(photos: list[Photo]) -> list[Photo]:
    """Return the photographs where those of one size and camera are all panoramas, or none is: what
    at least half of them look like."""
    alike: dict[object, list[Photo]] = {}
    for photo in photos:
        alike.setdefault((photo.size, photo.camera), []).append(photo)
    turned = {key for key, group in alike.items() if 2 * sum(photo.round for photo in group) >= len(group)}
    return [replace(photo, round=(photo.size, photo.camera) in turned) for photo in photos]


def describe_rest(found: Found, names: Sequence[str], others: Sequence[Path], folder: Path) -> list[str]:
    """Return lines about the masks of photographs and about files that are neither."""
    lines = []
    if found.masks:
        first = os.path.relpath(next(iter(found.masks.values())).path, folder)
        lines.append(f"{len(found.masks)} of {len(names)} photographs have a mask (first: {first})")
    lines += [f"warning: {warning}" for warning in found.warnings]
    ignored = [path.relative_to(folder).as_posix() for path in others if path.suffix.lower() not in HEIC]
    if ignored:
        lines.append(f"ignored {len(ignored)} file{'s' if len(ignored) > 1 else ''} that are no photographs: {few(ignored)}")
    return lines


def inspect_photos(folder: Path, names: Sequence[str], found: Found) -> list[Photo]:
    """Inspect photographs. Raises InputError that names all that cannot be read."""
    photos, bad = list[Photo](), list[tuple[str, InputError]]()
    for name in names:
        try:
            photos.append(inspect_photo(folder, name, found.masks.get(name)))
        except InputError as error:
            bad.append((name, error))
    if len(bad) > 1:
        raise InputError(
            f"expected photographs in {folder}, found {len(bad)} files that cannot be read: {few([name for name, _ in bad], 8)}; "
            "replace or remove them"
        )
    if bad:
        raise bad[0][1]
    return photos


def find_heic(files: Sequence[Path], others: set[Path], folder: Path) -> list[Path]:
    """Return the HEIC photographs among `files`, without those that `others` (paths without
    extension) has in another format.

    Raises InputError if there are any and pillow-heif is missing.
    """
    found = [path for path in files if path.suffix.lower() in HEIC and path.with_suffix("") not in others]
    if found:
        try:
            from pillow_heif import register_heif_opener
        except ImportError:
            raise InputError(
                f"expected the package pillow-heif to read the {len(found)} HEIC photographs in {folder}, found none; "
                f"{install_line('heic')}, or save them as JPEG"
            ) from None
        register_heif_opener()
    return found


def natural_key(name: str) -> list[tuple[int, str]]:
    """Return a sort key that orders the numbers in names by value."""
    return [(int(part), "") if part.isdecimal() else (-1, part.lower()) for part in re.split(r"(\d+)", name)]


def inspect_photo(folder: Path, name: str, mask: Mask | None) -> Photo:
    """Read the size and EXIF data of a photograph. Raises InputError if it is damaged or its name
    is not UTF-8."""
    path = folder / name
    try:
        name.encode()
    except UnicodeEncodeError:
        raise InputError(f"expected names in UTF-8 in {folder}, found {name!r}; rename the file") from None
    with opening_picture(path, CAPTURED, heic=True) as image:
        xmp = image.info.get("xmp", b"")
        round = b"equirectangular" in xmp.lower() if isinstance(xmp, bytes) else False
        size, mode, deep = image.size, describe_mode(image), is_deep(image.mode)
        readable, lossless = image.format in COLMAP_FORMATS and not deep, "A" in image.getbands() or deep
        exif = image.getexif()
        inner = exif.get_ifd(_EXIF)
        image.draft(None, (max(1, size[0] // 8), max(1, size[1] // 8)))
        image.load()
        round = round or (size[0] == 2 * size[1] and size[0] >= _SMALLEST_ROUND and is_seamless(np.asarray(image.convert("RGB"))))
        facts = (exif.get(_MAKE), exif.get(_MODEL), inner.get(_LENS), inner.get(_FOCAL))
        camera = tuple(str(value).strip()[:_LONGEST_FACT] for value in facts) if any(facts) else ()
        orientation = exif.get(ORIENTATION, 1)
    return Photo(
        name,
        size,
        camera,
        orientation if orientation in range(1, 9) else 1,
        "" if readable else ".png" if lossless else ".jpg",
        file_stamp(path) + ((*file_stamp(mask.path), mask.labels, mask.inverted) if mask else ()),
        mask,
        mode,
        round=round,
    )


def file_stamp(path: Path) -> tuple[int, int]:
    """Return the size in bytes and the modification time of a file."""
    return path.stat().st_size, path.stat().st_mtime_ns


def group_by_camera(photos: Sequence[Photo]) -> list[list[str]]:
    """Group names by camera: the same size, maker, model, lens and focal length. Each zoom setting
    is a camera of its own."""
    groups: dict[object, list[str]] = {}
    for photo in photos:
        groups.setdefault((photo.size, photo.camera), []).append(photo.name)
    return list(groups.values())


def check_in_place(photos: Sequence[Photo], folder: Path) -> list[Photo]:
    """Return the photographs of a capture's own image folder, which are not modified. Raises
    InputError if COLMAP cannot read one."""
    if other := next((photo for photo in photos if photo.name != photo.stored), None):
        raise InputError(f"COLMAP cannot read '{other.name}' in {folder} as it is; make a new capture from these photographs with --out")
    return list(photos)


def copy_photos(photos: Sequence[Photo], source: Path, target: Path, keep: Collection[str] = ()) -> list[Photo]:
    """Copy photographs and their masks into `target` under their stored names and return them.
    Other files in `target` are removed, but for those in its folders `keep`.

    Photographs that EXIF rotates are written upright at high quality: COLMAP uses the stored
    pixels, and a scene of sideways photographs would lie on its side. Existing copies are kept.
    """
    note = target.with_name(COPIED)
    kept: dict[str, list[float]] = read_json(note, "list of copies") if note.is_file() else {}
    wanted = {photo.stored: photo for photo in photos}
    stems = Counter(PurePosixPath(photo.stored).with_suffix("") for photo in photos)
    bare = {photo.stored: stem if stems[stem := PurePosixPath(photo.stored).with_suffix("")] == 1 else photo.stored for photo in photos}
    masks = {photo.stored: target / f"{bare[photo.stored]}_mask.png" for photo in photos if photo.mask}
    for path in [path for path in target.rglob("*") if path.is_file()]:
        name = path.relative_to(target)
        if name.as_posix() not in wanted and path not in masks.values() and name.parts[0] not in keep:
            path.unlink()
    for name, photo in wanted.items():
        new = target / name
        whole = new.is_file() and (name not in masks or masks[name].is_file())
        if not whole or tuple(kept.get(name, ())) != photo.stamp:
            transfer(source / photo.name, new, photo.orientation, photo.suffix, photo.white)
            if photo.mask:
                copy_mask(photo, masks[name])
            kept[name] = list(photo.stamp)
    write_json(note, {name: stamp for name, stamp in kept.items() if name in wanted})
    return [replace(photo.upright, mask=Mask(masks[photo.stored]) if photo.mask else None) for photo in photos]


def copy_mask(photo: Photo, new: Path) -> None:
    """Write the mask of `photo` upright, 255 where pixels count."""
    upright = turn_upright(read_stored_mask(photo), photo.orientation)
    upright.getexif().clear()
    write_atomic(new, lambda temporary: upright.save(temporary, "PNG"))


def read_stored_mask(photo: Photo) -> Image.Image:
    """Read the mask of `photo` in the orientation of the stored photograph, 255 where pixels count.

    A mask that is upright although EXIF rotates its photograph is rotated back. Raises InputError
    if the file is unreadable.
    """
    assert photo.mask is not None
    mask, (width, height) = read_mask(photo.mask), photo.size
    if photo.orientation in (5, 6, 7, 8) and (mask.width > mask.height) != (width > height):
        mask = turn_upright(mask, {6: 8, 8: 6}.get(photo.orientation, photo.orientation))
    return mask


def turn_upright(image: Image.Image, orientation: int) -> Image.Image:
    """Return a picture as it is shown with an orientation of EXIF, 1 to 8."""
    image.getexif()[ORIENTATION] = orientation
    return ImageOps.exif_transpose(image)


def transfer(old: Path, new: Path, orientation: int, suffix: str = "", white: White | None = None) -> None:
    """Copy a photograph, or rewrite it rotated upright (`orientation` as in EXIF) or in another
    format (`suffix`). Its colour profile is kept."""
    new.parent.mkdir(parents=True, exist_ok=True)
    if orientation == 1 and not suffix:
        write_atomic(new, lambda temporary: shutil.copyfile(old, temporary))
        return
    with opening_picture(old, CAPTURED, heic=True) as image:
        form = {".jpg": "JPEG", ".png": "PNG"}.get(suffix) or ("JPEG" if image.format == "MPO" else image.format)
        image = image if white is None else lift(image, white)
        upright = turn_upright(image, orientation)
        exif, upright = upright.getexif(), to_8_bit(upright, white) if is_deep(upright.mode) else upright
        profile = None if is_deep(image.mode) else image.info.get("icc_profile")
    if form == "JPEG":
        upright = upright if upright.mode in ("L", "RGB", "CMYK") else upright.convert("RGB")
        options = {"quality": 96, "subsampling": 0}
    else:
        options = {}
    write_atomic(new, lambda temporary: upright.save(temporary, form, exif=exif, icc_profile=profile, **options))
