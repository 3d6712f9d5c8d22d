"""Small photographs for a page: WebP pictures of one size, within a budget of bytes for all."""

from __future__ import annotations

import io

import numpy as np
from PIL import Image

from scene_experts.core.errors import InputError
from scene_experts.data.views import Capture

BYTES = 84_000  # of all pictures of a page; a third more in base64, a tenth of a page of a megabyte
SIDES = (320, 256, 192, 144, 112, 80)  # px of the longer side, the first whose pictures fit
_QUALITY = 55  # of WebP


def make_thumbnails(capture: Capture, most: int = BYTES) -> list[bytes]:
    """A WebP picture for each view, in the order of the views, of `most` bytes together. Where even
    the smallest take more, they belong to evenly spread views, and others have b"".

    Raises InputError for a capture without photographs.
    """
    if not capture.views or not len(capture.images):
        raise InputError("expected the run's photographs for --photographs, found none; say where they are with --data")
    chosen, pictures = list(range(len(capture.views))), list[bytes]()
    for side in SIDES:
        pictures = [_encode(capture, i, side) for i in chosen]
        if sum(map(len, pictures)) <= most:
            break
    count = len(chosen)
    while sum(map(len, pictures)) > most:
        count = min(count - 1, int(count * most / sum(map(len, pictures))))
        kept = set(np.linspace(0, len(chosen) - 1, count).round().astype(int).tolist())
        pictures = [picture if i in kept else b"" for i, picture in enumerate(pictures)]
    return pictures


def _encode(capture: Capture, index: int, side: int) -> bytes:
    image, stream = Image.fromarray(capture.frame(index).rgb.numpy()), io.BytesIO()
    image.thumbnail((side, side), Image.Resampling.LANCZOS)
    image.save(stream, "WEBP", quality=_QUALITY, method=4)
    return stream.getvalue()
