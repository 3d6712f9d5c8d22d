"""Opens pictures with Pillow, within limits on what they decode to."""

from __future__ import annotations

import io
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO

from PIL import Image, UnidentifiedImageError

from scene_experts.core.reading import budget as budgets
from scene_experts.core.reading import exr
from scene_experts.core.reading.budget import Budget, Damaged
from scene_experts.core.reading.source import Source, opening

FORMATS = ("BMP", "GIF", "JPEG", "PNG", "PPM", "TIFF", "WEBP")
"""The formats that are read, by their content. Pillow's others are not: each decoder is a way
in."""
HEIC = "HEIF"  # read too where pillow-heif has registered it, by those who pass `heic`
HEIC_BRANDS = (b"heic", b"heix", b"hevc", b"hevx", b"heim", b"heis", b"mif1", b"msf1")
SIDE_LIMIT = 1 << 17  # px
ORIENTATION = 0x0112  # tag of EXIF and TIFF
_STORED = 4  # bytes per pixel in Pillow's memory, at most


@contextmanager
def opening_picture(path: Path, budget: Budget = budgets.PICTURE, heic: bool = False) -> Iterator[Image.Image]:
    """Open the picture at `path` without decoding it. The block decodes it to the pixels as they
    are stored, whatever its EXIF orientation.

    `heic` admits HEIC photographs where pillow-heif reads them. Files that end in .exr are read with
    the package OpenEXR.
    Raises InputError if it is absent, damaged, of another format or beyond the budget, or if the
    block fails.
    """
    formats = (*FORMATS, HEIC) if heic and HEIC in Image.OPEN else FORMATS
    if path.suffix.lower() == exr.SUFFIX:
        exr.register(path)
        formats = (*formats, exr.FORMAT)
    with opening(path, budget) as source, source.stream() as stream, _identify(stream, formats) as image:
        check_size(source, image)
        keep_as_stored(image)
        yield image


def _identify(stream: IO[bytes], formats: tuple[str, ...]) -> Image.Image:
    try:
        return Image.open(stream, formats=formats)
    except UnidentifiedImageError:
        stream.seek(0)
        head = stream.read(12)
        if head[4:8] == b"ftyp" and head[8:] in HEIC_BRANDS:
            raise Damaged("a HEIC photograph, whatever its name says; rename it to .heic, from which `capture` makes a JPEG") from None
        raise


def keep_as_stored(image: Image.Image) -> None:
    """Decode a TIFF file with an orientation to its stored pixels. Pillow would turn it upright and
    drop the orientation, unlike the pictures of other formats, and unlike COLMAP."""
    if image.format != "TIFF":
        return
    exif = image.getexif()
    orientation = exif.get(ORIENTATION, 1)
    if orientation != 1:
        exif[ORIENTATION] = 1
        image.load()
        exif[ORIENTATION] = orientation
        image._size = image.im.size  # pyright: ignore[reportPrivateUsage]


def decode_picture(data: bytes, pixels: int, *formats: str) -> Image.Image:
    """Decode a picture of one of the formats that is a part of another file. Raises Damaged for
    more than `pixels` pixels."""
    with Image.open(io.BytesIO(data), formats=formats) as image:
        if image.width * image.height > pixels or max(image.size) > SIDE_LIMIT:
            raise Damaged(f"a picture of {image.width} x {image.height} pixels")
        image.load()
        return image.copy()


def check_size(source: Source, image: Image.Image) -> None:
    """Raise Damaged for a picture whose pixels take more memory than the budget allows."""
    if max(image.size) > SIDE_LIMIT or min(image.size) < 1:
        raise Damaged(f"a picture of {image.width} x {image.height} pixels")
    source.spend_bytes(_STORED * image.width * image.height)
