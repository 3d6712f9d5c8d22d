"""Lets Pillow open OpenEXR pictures, with the package OpenEXR: linear light, to which the curve of
sRGB is applied. Values from 1 on are white."""

from __future__ import annotations

import contextlib
import sys
import tempfile
import threading
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from scene_experts.core.errors import InputError
from scene_experts.core.extras import install_line
from scene_experts.core.reading.budget import Damaged

FORMAT, MAGIC, SUFFIX = "EXR", b"v/1\x01", ".exr"
_MOST = 1 << 28  # pixels
_told = threading.Lock()
_LAYERS = (("R", "G", "B", "A"), ("R", "G", "B"), ("Y", "A"), ("Y",))


def register(path: Path) -> None:
    """Let Pillow open EXR files. Raises InputError, for the file at `path`, if the package is
    missing."""
    try:
        import OpenEXR  # noqa: F401
    except ImportError:
        raise InputError(
            f"expected the package OpenEXR to read {path}, found none; {install_line('exr')}, or save the photographs as PNG"
        ) from None
    Image.register_open(FORMAT, _open, lambda head: head.startswith(MAGIC))  # pyright: ignore[reportArgumentType]  # any Image will do


def _open(stream: IO[bytes], _: object) -> Image.Image:
    """Decode the first part of a file to L, LA, RGB or RGBA of 8 bits."""
    import OpenEXR

    with tempfile.TemporaryDirectory(prefix="scene-experts-exr-") as folder:
        path = Path(folder) / "picture.exr"  # the library reads files alone
        path.write_bytes(stream.read())
        with OpenEXR.File(str(path), header_only=True) as file:
            low, high = (np.asarray(corner, np.int64) for corner in file.header()["dataWindow"])
            if (high < low).any() or int(np.prod(high - low + 1)) > _MOST:
                raise Damaged(f"a picture from {low.tolist()} to {high.tolist()}")
        # The library leaves out a part that it cannot read, and only prints why.
        with _told, contextlib.redirect_stdout(_Ear()) as ear, OpenEXR.File(str(path), separate_channels=True) as file:
            if ear.said:
                raise Damaged(ear.said.strip().rpartition(" - ")[2])
            found: dict[str, Any] = {name: channel.pixels for name, channel in file.channels().items()}
    layers = next((names for names in _LAYERS if all(name in found for name in names)), None)
    if layers is None:
        raise Damaged(f"the channels {', '.join(sorted(found)[:8])} where R, G and B, or Y, are expected")
    pixels = np.stack([encode(found[name]) if name != "A" else _to_bytes(found[name].astype(np.float32)) for name in layers], -1)
    image = Image.fromarray(pixels if pixels.shape[2] > 1 else pixels[..., 0])
    image.format = FORMAT
    return image


class _Ear:
    """Standard output that keeps what this thread prints and passes on what others print."""

    def __init__(self) -> None:
        self.said, self._thread, self._before = "", threading.get_ident(), sys.stdout

    def write(self, text: str) -> int:
        if threading.get_ident() != self._thread:
            return self._before.write(text)
        self.said += text
        return len(text)

    def flush(self) -> None:
        self._before.flush()

    def __getattr__(self, name: str) -> Any:
        return getattr(self._before, name)


def encode(values: NDArray[Any]) -> NDArray[np.uint8]:
    """Return linear values as bytes of sRGB (IEC 61966-2-1)."""
    light = np.nan_to_num(values.astype(np.float32), posinf=1.0).clip(0, 1)
    return _to_bytes(np.where(light <= 0.0031308, 12.92 * light, 1.055 * light ** (1 / 2.4) - 0.055))


def _to_bytes(values: NDArray[np.float32]) -> NDArray[np.uint8]:
    return np.rint(255 * np.nan_to_num(values).clip(0, 1)).astype(np.uint8)
