"""Niantic's SPZ, small; phones and glTF tools read it.

It is written as version 3 (one gzip stream, which every reader accepts) and read in versions 1 to 4
(4 needs `zstandard`). The file stores one attribute after the other: positions in 24-bit fixed
point, opacity, colour, log scale (steps of 1/16 from -10), rotation (the smallest three components,
10 bits each), and harmonics over [-1, 1]. The frame is x right, y up, z back: half a turn about x
from ours. Files of other programs may hold further records (type, length, content). The one that
names another frame is followed, others are passed over.
"""

from __future__ import annotations

import gzip
import struct
import zlib
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from scene_experts.core.errors import InputError
from scene_experts.core.io import write_bytes
from scene_experts.core.reading import budget
from scene_experts.core.reading.budget import CutShort, Damaged
from scene_experts.core.reading.source import Source, opening
from scene_experts.files.formats.pack import (
    Bytes,
    Floats,
    alphas,
    byte_logits,
    check_count,
    decoded_bytes,
    flip,
    from_smallest_three,
    morton_order,
    smallest_three,
    tensor,
    to_bytes,
    turn,
    unit_quats,
)
from scene_experts.files.formats.splats import Splats, tell_degree
from scene_experts.files.registry import Format

MAGIC, HEADER = 0x5053474E, struct.Struct("<IIIBBBB")
V4_HEADER = struct.Struct("<IIIBBBBI12x")
_ZSTD_WINDOW = 1 << 27  # bytes that a zstd frame may look back, which the decoder allocates
ANTIALIASED, _FLAGS = 1, 14  # a bit of the flags, and the offset of the flags in the header of every version
EXTENDED = 2  # a bit of the flags: records follow the attributes, or in version 4 the header
FRAME = 0xADBE0003  # type of the record that names the frame, by a number
_OWN_FRAME = (1, -1, -1)  # signs of our axes in the frame of a file without such a record
_RECORDS = 1 << 20  # bytes of all records, at most
_STREAMS = ("positions", "alphas", "colors", "scales", "rotations", "sh")
_COLOR = 0.15  # share of a byte's range per unit of the constant harmonic
_MAX_BITS = 20  # of a position's fraction
_ROTATION = 511 * np.sqrt(2)
_LOG_SCALES = (-10.0, 255 / 16 - 10)
FARTHEST = 1 << 22  # units; positions must be nearer


def write(path: Path, splats: Splats, note: dict[str, Any]) -> str | None:
    """Write version 3. Of the note it stores `antialias` only. Returns a warning about sizes that
    the format cannot hold, or None."""
    write_bytes(path, spz_bytes(splats, antialias=bool(note.get("antialias", False))))
    return size_warning(splats)


def out_of_range(splats: Splats) -> Tensor:
    """Which Gaussians [N] have a wrong size in the file: an axis longer than the longest that it
    holds, or all shorter than the shortest. A single short axis is harmless: such a Gaussian stays
    flat."""
    longest, (low, high), half_step = splats.log_scales.amax(1), _LOG_SCALES, 1 / 32
    return (longest > high + half_step) | (longest < low - half_step)


def size_warning(splats: Splats) -> str | None:
    """A sentence about the Gaussians of `out_of_range`; None without any."""
    count = int(out_of_range(splats).sum())
    if not count:
        return None
    low, high = (float(f"{np.exp(value):.2g}") for value in _LOG_SCALES)
    return (
        f"warning: {count:,} of {len(splats):,} Gaussians have sizes outside {low:g} to {high:g} units, which SPZ cannot hold, "
        "and are clipped; choose another --format (sog, ply)"
    )


def spz_bytes(splats: Splats, first_step: int = 1, rest_step: int = 1, antialias: bool = False) -> bytes:
    """The bytes of an SPZ file, version 3. antialias: whether to draw it with the compensation of
    the 0.3 px blur.

    first_step, rest_step: step of the harmonics of degree 1 and above, in 1/128. The format's first
    writer uses 8 and 16, which saves a third of the bytes and costs a trained scene up to 20 dB
    against its own picture; 1 keeps all that a byte holds. Positions have as many fraction bits as
    their range leaves, 12 for a range of 2 km.
    """
    s = turn(splats.rows(morton_order(splats.means)), "x")
    means = s.means.double().numpy()
    reach = float(np.abs(means).max()) if len(s) else 1.0
    bits = max(0, min(_MAX_BITS, 22 - int(np.floor(np.log2(max(reach, 1e-9))))))
    if reach >= FARTHEST:
        raise InputError(f"expected positions within {FARTHEST:,} units for SPZ, found one at {reach:.3g}; remove far Gaussians")
    fixed = np.clip(np.rint(means * (1 << bits)), -(1 << 23), (1 << 23) - 1).astype("<i4")
    positions = np.ascontiguousarray(fixed).view(np.uint8).reshape(-1, 3, 4)[..., :3]
    colors = to_bytes(s.sh[:, 0].double().numpy() * _COLOR + 0.5)
    scales = np.clip(np.rint((s.log_scales.double().numpy() + 10) * 16), 0, 255).astype(np.uint8)
    sh = _harmonics(s.sh[:, 1:].double().numpy(), first_step, rest_step)
    head = HEADER.pack(MAGIC, 3, len(s), s.degree, bits, ANTIALIASED if antialias else 0, 0)
    streams = (positions, to_bytes(alphas(s)), colors, scales, _pack_quats(unit_quats(s)), sh)
    return gzip.compress(head + b"".join(part.tobytes() for part in streams), 6, mtime=0)


def read(path: Path) -> Splats:
    """The Gaussians of a file of version 1 to 4. Raises InputError for other or damaged files."""
    with opening(path, budget.SPZ) as source:
        return decode(source.read(), source).checked(path)


def is_antialiased(path: Path) -> bool:
    """Whether a file says that it is drawn with antialiasing; False for damaged files."""
    with opening(path, budget.SPZ) as source:
        data = source.head(4096)
        try:
            head = data if data[:4] == b"NGSP" else zlib.decompressobj(31).decompress(data, HEADER.size)
        except zlib.error:
            return False
    return len(head) > _FLAGS and bool(head[_FLAGS] & ANTIALIASED)


def decode(data: bytes, source: Source) -> Splats:
    """The Gaussians in the bytes of a file. Raises Damaged."""
    version, n, degree, bits, records, streams = _streams_v4(data, source) if data[:4] == b"NGSP" else _streams_gzip(data, source)
    means = _positions(streams["positions"], version, n, bits)
    if not np.isfinite(means).all():
        raise Damaged("positions that are not finite")
    quats = _unpack_quats(streams["rotations"], n) if version >= 3 else _unpack_xyz(streams["rotations"], n)
    tell_degree(degree)
    count = (min(degree, 3) + 1) ** 2
    sh = np.empty((n, count, 3), np.float32)  # in place: most of the memory of a file is here
    sh[:, 0] = (streams["colors"].reshape(n, 3) / 255.0 - 0.5) / _COLOR
    sh[:, 1:] = streams["sh"].reshape(n, (degree + 1) ** 2 - 1, 3)[:, : count - 1]
    sh[:, 1:] -= 128
    sh[:, 1:] /= 128
    scales = streams["scales"].reshape(n, 3) / 16.0 - 10
    stored = Splats(tensor(means), tensor(scales), tensor(quats), tensor(byte_logits(streams["alphas"])), torch.from_numpy(sh))
    return flip(stored, _signs(records), reuse=True)


# --- containers ---------------------------------------------------------------------------------------------------------------------------


def _check_header(source: Source, magic: int, version: int, n: int, degree: int, bits: int, versions: range) -> None:
    if magic != MAGIC or version not in versions:
        raise Damaged(f"a header of version {version}" if magic == MAGIC else "another header")
    if degree > 4 or bits > 24:
        raise Damaged(f"harmonics of degree {degree} and {bits} bits of fraction")
    check_count(source, n, decoded_bytes(degree))


def _sizes(version: int, n: int, degree: int) -> dict[str, int]:
    """Bytes of each stream."""
    widths = (6 if version == 1 else 9, 1, 3, 3, 4 if version >= 3 else 3, 3 * ((degree + 1) ** 2 - 1))
    return {name: n * width for name, width in zip(_STREAMS, widths)}


def _signs(records: bytes) -> tuple[int, int, int]:
    """The signs of our axes in the frame that the records name. Raises Damaged for a frame whose
    axes are in another order.

    Frame n is 1 + 1 (x right, else left) + 2 (y up, else down) + 4 (z forward, else back); 0 says
    nothing.
    """
    at = 0
    while at + 8 <= len(records):
        kind, size = struct.unpack_from("<II", records, at)
        if kind == FRAME and size == 4 and at + 12 <= len(records):
            frame = int.from_bytes(records[at + 8 : at + 12], "little")
            if frame > 8:
                raise Damaged(f"frame {frame}, whose axes are in another order than x, y, z")
            bits = frame - 1
            return _OWN_FRAME if frame == 0 else (1 if bits & 1 else -1, -1 if bits & 2 else 1, 1 if bits & 4 else -1)
        at += 8 + size
    return _OWN_FRAME


def _streams_gzip(data: bytes, source: Source) -> tuple[int, int, int, int, bytes, dict[str, Bytes]]:
    """Version, count, degree, bits of fraction, the records and the streams of versions 1 to 3."""
    machine = zlib.decompressobj(31)
    head = machine.decompress(data, HEADER.size)
    if len(head) < HEADER.size:
        raise CutShort("no whole header")
    magic, version, n, degree, bits, flags, _ = HEADER.unpack(head)
    _check_header(source, magic, version, n, degree, bits, range(1, 4))
    sizes = _sizes(version, n, degree)
    total = sum(sizes.values())
    body = machine.decompress(machine.unconsumed_tail, total + (_RECORDS if flags & EXTENDED else 1))
    if len(body) < total or (len(body) > total and not flags & EXTENDED):
        kind = CutShort if len(body) < total else Damaged
        raise kind(f"{len(body):,} bytes of attributes where {total:,} are expected")
    ends = np.cumsum([0, *sizes.values()])
    flat = np.frombuffer(body, np.uint8)
    return version, n, degree, bits, body[total:], {name: flat[ends[i] : ends[i + 1]] for i, name in enumerate(_STREAMS)}


def _streams_v4(data: bytes, source: Source) -> tuple[int, int, int, int, bytes, dict[str, Bytes]]:
    """The same for version 4: a plain header, the records, a table of sizes, and one zstd stream
    per attribute."""
    try:
        import zstandard
    except ImportError:
        raise InputError(
            f"expected the package zstandard to read {source.path} (SPZ version 4), found none; pip install zstandard"
        ) from None
    if len(data) < V4_HEADER.size:
        raise CutShort("no whole header")
    magic, version, n, degree, bits, flags, count, table = V4_HEADER.unpack_from(data)
    _check_header(source, magic, version, n, degree, bits, range(4, 5))
    sizes = {name: size for name, size in _sizes(version, n, degree).items() if size or count == len(_STREAMS)}
    if count != len(sizes) or table < V4_HEADER.size or table + 16 * count > len(data):
        raise Damaged(f"a table of {count} streams where {len(sizes)} are expected")
    out: dict[str, Bytes] = {name: np.zeros(0, np.uint8) for name in _STREAMS}
    offset = table + 16 * count
    for i, (name, size) in enumerate(sizes.items()):
        packed, raw = struct.unpack_from("<QQ", data, table + 16 * i)
        part = data[offset : offset + packed]
        offset += packed
        if len(part) != packed:
            raise CutShort(f"{len(part):,} bytes of a stream of {name} of {packed:,}")
        if raw != size:
            raise Damaged(f"a stream of {name} that is not {size:,} bytes long")
        out[name] = np.frombuffer(_unpack_zstd(zstandard, part, size), np.uint8)
    records = data[V4_HEADER.size : table] if flags & EXTENDED else b""
    return version, n, degree, bits, records[:_RECORDS], out


def _unpack_zstd(zstandard: Any, part: bytes, size: int) -> bytes:
    """The `size` bytes of a zstd frame. Raises Damaged for a frame that declares or holds another
    number, and for a huge window."""
    if not part and not size:
        return b""
    if zstandard.frame_content_size(part) != size:
        raise Damaged(f"a stream that does not unpack to {size:,} bytes")
    found = zstandard.ZstdDecompressor(max_window_size=_ZSTD_WINDOW).decompress(part, max_output_size=size)
    if len(found) != size:
        raise Damaged(f"a stream that does not unpack to {size:,} bytes")
    return found


# --- attributes ---------------------------------------------------------------------------------------------------------------------------


def _positions(stream: Bytes, version: int, n: int, bits: int) -> Floats:
    if version == 1:
        return stream.view("<f2").astype(np.float64).reshape(n, 3)
    parts = stream.reshape(n, 3, 3).astype(np.int32)
    fixed = parts[..., 0] | parts[..., 1] << 8 | parts[..., 2] << 16
    return np.where(fixed >= 1 << 23, fixed - (1 << 24), fixed) / float(1 << bits)


def _harmonics(rest: Floats, first_step: int, rest_step: int) -> Bytes:
    """Bytes [N, C, 3]: multiples of the step around 128."""
    step = np.where(np.arange(rest.shape[1]) < 3, first_step, rest_step)[:, None]
    level = np.rint(rest * 128)
    return np.clip(np.floor((level + 128 + step // 2) / step) * step, 0, 255).astype(np.uint8)


def _pack_quats(quats: Floats) -> NDArray[np.uint32]:
    """The index of the largest of x, y, z, w in the top 2 bits, then sign and 9 bits of each other
    component."""
    largest, rest = smallest_three(quats[:, [1, 2, 3, 0]])
    level = np.clip(np.rint(np.abs(rest) * _ROTATION), 0, 511).astype(np.uint32) | (rest < 0).astype(np.uint32) << np.uint32(9)
    return (largest.astype(np.uint32) << np.uint32(30) | level @ np.array([1 << 20, 1 << 10, 1], np.uint32)).astype("<u4")


def _unpack_quats(stream: Bytes, n: int) -> Floats:
    packed = stream.view("<u4").reshape(n)
    level = np.stack([packed >> shift & 1023 for shift in (20, 10, 0)], 1)
    rest = (level & 511) / _ROTATION * np.where(level >> 9, -1.0, 1.0)
    return from_smallest_three(packed >> 30, rest)[:, [3, 0, 1, 2]]


def _unpack_xyz(stream: Bytes, n: int) -> Floats:
    """Versions 1 and 2: x, y, z in a byte each, w positive."""
    xyz = stream.reshape(n, 3) / 127.5 - 1
    w = np.sqrt(np.maximum(0.0, 1 - (xyz * xyz).sum(1, keepdims=True)))
    quats = np.concatenate([w, xyz], 1)
    return quats / np.linalg.norm(quats, axis=1, keepdims=True)


FORMAT = Format(
    suffix=".spz",
    write=write,
    read=read,
    marks=(b"\x1f\x8b", b"NGSP"),
    antialias=True,
    is_antialiased=is_antialiased,
)
