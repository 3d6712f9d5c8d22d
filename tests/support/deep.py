"""Writers of pictures with colours of 16 bits, which Pillow cannot write."""

import struct
import zlib
from pathlib import Path

import numpy as np


def write_png16(path: Path, values: np.ndarray, kind: int) -> None:
    """Write 16-bit colours as PNG: `kind` 2 is RGB, 6 RGBA."""
    height, width, _ = values.shape
    rows = b"".join(b"\0" + row.astype(">u2").tobytes() for row in values)
    chunks = [(b"IHDR", struct.pack(">IIBBBBB", width, height, 16, kind, 0, 0, 0)), (b"IDAT", zlib.compress(rows)), (b"IEND", b"")]
    packed = (struct.pack(">I", len(d)) + t + d + struct.pack(">I", zlib.crc32(t + d)) for t, d in chunks)
    path.write_bytes(b"\x89PNG\r\n\x1a\n" + b"".join(packed))


def write_tiff16(path: Path, values: np.ndarray, order: str) -> None:
    """Write 16-bit colours as an uncompressed TIFF in either byte order."""
    height, width, channels = values.shape
    body = values.astype(f"{order}u2").tobytes()
    bits = 8 + len(body)
    tags = [(256, 4, 1, width), (257, 4, 1, height), (258, 3, channels, bits), (259, 3, 1, 1), (262, 3, 1, 2), (273, 4, 1, 8)]
    tags += [(277, 3, 1, channels), (278, 4, 1, height), (279, 4, 1, len(body))]
    start = bits + 2 * channels
    out = (
        struct.pack(f"{order}2sHI", b"II" if order == "<" else b"MM", 42, start)
        + body
        + struct.pack(f"{order}{channels}H", *[16] * channels)
    )
    out += struct.pack(f"{order}H", len(tags))
    for tag, kind, count, value in tags:
        out += struct.pack(f"{order}HHI", tag, kind, count) + struct.pack(f"{order}{'I' if kind == 4 or count > 1 else 'H2x'}", value)
    path.write_bytes(out + bytes(4))
