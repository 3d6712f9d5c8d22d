"""Opens pictures with Pillow, within limits on what they decode to."""

from __future__ import annotations

import io
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from PIL import Image

from scene_experts.core.reading import budget as budgets
from scene_experts.core.reading.budget import Budget, Damaged
from scene_experts.core.reading.source import Source, opening

FORMATS = ("BMP", "GIF", "JPEG", "PNG", "PPM", "TIFF", "WEBP")
"""The formats that are read, by their content. Pillow's others are not: each decoder is a way in."""
HEIC = "HEIF"  # read too where pillow-heif has registered it, by those who pass `heic`
SIDE_LIMIT = 1 << 17  # px
_STORED = 4  # bytes per pixel in Pillow's memory, at most


@contextmanager
def opening_picture(path: Path, budget: Budget = budgets.PICTURE, heic: bool = False) -> Iterator[Image.Image]:
    """Open the picture at `path` without decoding it. The block decodes it.

    `heic` admits HEIC photographs where pillow-heif reads them.
    Raises InputError if it is absent, damaged, of another format or beyond the budget, or if the block fails.
    """
    formats = (*FORMATS, HEIC) if heic and HEIC in Image.OPEN else FORMATS
    with opening(path, budget) as source, source.stream() as stream, Image.open(stream, formats=formats) as image:
        check_size(source, image)
        yield image


def decode_picture(data: bytes, pixels: int, format: str) -> Image.Image:
    """Decode a picture of one format that is a part of another file. Raises Damaged for more than `pixels` pixels."""
    with Image.open(io.BytesIO(data), formats=[format]) as image:
        if image.width * image.height > pixels or max(image.size) > SIDE_LIMIT:
            raise Damaged(f"a picture of {image.width} x {image.height} pixels")
        image.load()
        return image.copy()


def check_size(source: Source, image: Image.Image) -> None:
    """Raise Damaged for a picture whose pixels take more memory than the budget allows."""
    if max(image.size) > SIDE_LIMIT or min(image.size) < 1:
        raise Damaged(f"a picture of {image.width} x {image.height} pixels")
    source.spend_bytes(_STORED * image.width * image.height)
