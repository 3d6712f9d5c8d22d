"""Writes the masks of photographs in COLMAP's format. COLMAP extracts no features where a mask is
black."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from pathlib import Path

from PIL import Image

from scene_experts.core.reading.budget import CAPTURED
from scene_experts.core.reading.pictures import opening_picture
from scene_experts.sfm.photos import Photo, read_stored_mask
from scene_experts.sfm.work import remove


def write_masks(photos: Sequence[Photo], images: Path, folder: Path) -> list[str]:
    """Write FOLDER/NAME.png for every photograph NAME in the folder `images`, if any photograph has
    a mask.

    The mask of a photograph is its mask file or its alpha channel. It is
    written at the size of the photograph, 255 where features are extracted and 0 elsewhere. COLMAP
    skips photographs without a mask if others have one, so those get a white mask.

    Returns a checksum of each written mask; an empty list if no photograph has a mask.
    Raises InputError if a mask file is unreadable.
    """
    remove(folder)
    if not any(photo.mask or has_alpha(images / photo.name) for photo in photos):
        return []
    checksums = []
    for photo in photos:
        if photo.mask:
            mask = read_stored_mask(photo).resize(photo.size, Image.Resampling.NEAREST).point(binarise)
        else:
            mask = read_alpha(images / photo.name)
        new = folder / f"{photo.name}.png"
        new.parent.mkdir(parents=True, exist_ok=True)
        mask.save(new)
        checksums.append(hashlib.sha256(new.read_bytes()).hexdigest())
    return checksums


def has_alpha(path: Path) -> bool:
    """Return whether an image has an alpha channel or a transparent colour."""
    with opening_picture(path, CAPTURED, heic=True) as image:
        return "A" in image.getbands() or "transparency" in image.info


def read_alpha(path: Path) -> Image.Image:
    """Return the alpha channel of a photograph as a mask. It is white if there is no alpha
    channel."""
    with opening_picture(path, CAPTURED, heic=True) as image:
        return image.convert("RGBA").getchannel("A").point(binarise) if has_alpha(path) else Image.new("L", image.size, 255)


def binarise(value: int) -> int:
    """Return 255 for a value of at least 128, otherwise 0."""
    return 255 if value >= 128 else 0
