"""Writes the masks of photographs in COLMAP's format. COLMAP extracts no features where a mask is
black."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from pathlib import Path

from PIL import Image, ImageOps

from scene_experts.core.reading.budget import CAPTURED
from scene_experts.core.reading.pictures import opening_picture
from scene_experts.data.images import to_mask
from scene_experts.data.match import find_mask
from scene_experts.sfm.photos import Photo
from scene_experts.sfm.work import remove


def write_masks(photos: Sequence[Photo], images: Path, folder: Path) -> list[str]:
    """Write FOLDER/NAME.png for every photograph NAME in the folder `images`, if any photograph has
    a mask.

    The mask of a photograph is a mask file, found as training finds it, or its alpha channel. It is
    written at the size of the photograph, 255 where features are extracted and 0 elsewhere. COLMAP
    skips photographs without a mask if others have one, so those get a white mask.

    Returns a checksum of each written mask; an empty list if no photograph has a mask.
    Raises InputError if a mask file is unreadable.
    """
    remove(folder)
    if not any(find_photo_mask(photo, images) or has_alpha(images / photo.name) for photo in photos):
        return []
    checksums = []
    for photo in photos:
        path = find_photo_mask(photo, images)
        mask = read_mask(path, photo) if path else read_alpha(images / photo.name)
        new = folder / f"{photo.name}.png"
        new.parent.mkdir(parents=True, exist_ok=True)
        mask.save(new)
        checksums.append(hashlib.sha256(new.read_bytes()).hexdigest())
    return checksums


def find_photo_mask(photo: Photo, images: Path) -> Path | None:
    """Return the mask file of a photograph, or None."""
    return find_mask(images.parent, photo.name, images / photo.name)


def has_alpha(path: Path) -> bool:
    """Return whether an image has an alpha channel or a transparent colour."""
    with opening_picture(path, CAPTURED, heic=True) as image:
        return "A" in image.getbands() or "transparency" in image.info


def read_mask(path: Path, photo: Photo) -> Image.Image:
    """Read the mask file of `photo` at the size and in the orientation of the stored photograph.

    A mask that is upright although EXIF rotates its photograph is rotated back. Raises InputError
    if the file is unreadable.
    """
    with opening_picture(path, CAPTURED) as image:
        mask = to_mask(image)
    width, height = photo.size
    if photo.orientation in (5, 6, 7, 8) and (mask.width > mask.height) != (width > height):
        mask.getexif()[0x0112] = {6: 8, 8: 6}.get(photo.orientation, photo.orientation)
        mask = ImageOps.exif_transpose(mask)
    return mask.resize(photo.size, Image.Resampling.NEAREST).point(binarise)


def read_alpha(path: Path) -> Image.Image:
    """Return the alpha channel of a photograph as a mask. It is white if there is no alpha
    channel."""
    with opening_picture(path, CAPTURED, heic=True) as image:
        return image.convert("RGBA").getchannel("A").point(binarise) if has_alpha(path) else Image.new("L", image.size, 255)


def binarise(value: int) -> int:
    """Return 255 for a value of at least 128, otherwise 0."""
    return 255 if value >= 128 else 0
