"""Which pixels of the photographs count, as COLMAP reads it: no feature is sought where none does."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from pathlib import Path

from PIL import Image, ImageOps

from scene_experts.core.errors import InputError
from scene_experts.data.images import to_mask
from scene_experts.data.match import find_mask
from scene_experts.sfm.photos import Photo
from scene_experts.sfm.work import remove


def write(photos: Sequence[Photo], images: Path, folder: Path) -> list[str]:
    """Write FOLDER/NAME.png for every photograph NAME in folder `images`, if any has a mask: a file (where training looks for it) or alpha.

    0 where no feature is to be sought, 255 elsewhere, of the photograph's size. Where some
    have one, COLMAP passes over those that have none: they get a white one. Returns what tells these masks from others, [] for none.
    Raises InputError for a mask file that is not whole.
    """
    remove(folder)
    if not any(mask_file(photo, images) or see_through(images / photo.name) for photo in photos):
        return []
    marks = []
    for photo in photos:
        path = mask_file(photo, images)
        mask = read(path, photo) if path else alpha(images / photo.name)
        new = folder / f"{photo.name}.png"
        new.parent.mkdir(parents=True, exist_ok=True)
        mask.save(new)
        marks.append(hashlib.sha256(new.read_bytes()).hexdigest())
    return marks


def mask_file(photo: Photo, images: Path) -> Path | None:
    """Where the mask of a photograph is, if it has one."""
    return find_mask(images.parent, photo.name, images / photo.name)


def see_through(path: Path) -> bool:
    """Whether a photograph has an alpha channel."""
    with Image.open(path) as image:
        return "A" in image.getbands() or "transparency" in image.info


def read(path: Path, photo: Photo) -> Image.Image:
    """The mask file of `photo`, at its size, lying as the photograph is stored, also where EXIF turns this one and the mask is upright."""
    try:
        with Image.open(path) as image:
            mask = to_mask(image)
    except (OSError, ValueError, SyntaxError) as error:
        raise InputError(f"expected a whole mask at {path}, found one that is not ({error}); replace it or take it away") from error
    width, height = photo.size
    if photo.orientation in (5, 6, 7, 8) and (mask.width > mask.height) != (width > height):
        mask.getexif()[0x0112] = {6: 8, 8: 6}.get(photo.orientation, photo.orientation)
        mask = ImageOps.exif_transpose(mask)
    return mask.resize(photo.size, Image.Resampling.NEAREST).point(binary)


def alpha(path: Path) -> Image.Image:
    """The alpha of a photograph, white where it has none."""
    with Image.open(path) as image:
        return image.convert("RGBA").getchannel("A").point(binary) if see_through(path) else Image.new("L", image.size, 255)


def binary(value: int) -> int:
    """255 for what counts at least by half."""
    return 255 if value >= 128 else 0
