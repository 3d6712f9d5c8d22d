"""Colours of 16 bits, of which Pillow decodes the upper 8: which pictures have them, and all their
bits."""

from __future__ import annotations

import io
import sys

import numpy as np
from numpy.typing import NDArray
from PIL import Image
from PIL.ImageFile import ImageFile

from scene_experts.core.reading.pictures import keep_as_stored

COLOR16 = ";16"  # marks colours of 16 bits


def describe_mode(image: Image.Image) -> str:
    """Return the mode of a picture that is not decoded yet, with COLOR16 behind it for colours of
    16 bits, of which Pillow decodes the upper 8."""
    return image.mode + COLOR16 if image.mode in ("RGB", "RGBA") and _raw_mode(image) is not None else image.mode


def _raw_mode(image: Image.Image) -> str | None:
    """Return how the file stores colours of 16 bits, such as "RGB;16B", or None for others."""
    tiles = getattr(image, "tile", None) or []
    args = tiles[0].args if tiles else None
    raw = args if isinstance(args, str) else args[0] if args and isinstance(args[0], str) else ""
    return raw if raw[-4:] in (";16B", ";16L", ";16N") and raw.startswith(image.mode) else None


def read_deep_colors(image: Image.Image) -> NDArray[np.int64]:
    """Return all 16 bits [H, W, C] of a picture that `describe_mode` marks. Decodes it twice: with
    the other order of bytes, Pillow keeps the lower 8 bits."""
    assert isinstance(image, ImageFile) and image.fp is not None and image.format is not None
    image.fp.seek(0)
    data, bytes_of = image.fp.read(), []
    for lower in (False, True):
        with Image.open(io.BytesIO(data), formats=(image.format,)) as again:
            if lower:
                raw = _raw_mode(again)
                assert raw is not None
                native = "L" if sys.byteorder == "little" else "B"
                order = raw[-1].replace("N", native)
                swapped = raw[:-1] + ("B" if order == "L" else "L")
                tile = again.tile[0]
                args = (swapped, *tile.args[1:]) if isinstance(tile.args, tuple) else swapped
                again.tile = [type(tile)(tile[0], tile[1], tile[2], args), *(t for t in again.tile[1:])]
            keep_as_stored(again)
            bytes_of.append(np.asarray(again).astype(np.int64))
    return bytes_of[0] * 256 + bytes_of[1]
