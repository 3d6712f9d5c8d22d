"""SuperSplat's compressed PLY, 16 to 61 bytes per Gaussian.

Gaussians are stored in chunks of 256. A chunk stores the minimum and maximum of position, log scale
and colour; files of SuperSplat before 2.0 have no ranges of colours. A Gaussian stores position and
log scale in 11-10-11 bits within those ranges, the smallest three components of its quaternion in
10 bits each with the index of the largest, and colour and opacity in 8-8-8-8 bits. Harmonics above
the constant are bytes over [-4, 4]. Sorting along the Morton curve keeps the ranges small.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from scene_experts.core.io import write_bytes
from scene_experts.core.reading import budget
from scene_experts.core.reading.budget import CutShort, Damaged
from scene_experts.core.reading.source import Source, opening
from scene_experts.core.reading.vertices import HEADER_LIMIT, TYPES, parse_count
from scene_experts.files.formats.pack import (
    Floats,
    alphas,
    byte_logits,
    from_smallest_three,
    morton_order,
    smallest_three,
    tensor,
    to_bytes,
    unit_quats,
)
from scene_experts.files.formats.ply import header, is_antialiased, note_comments, read_note
from scene_experts.files.formats.splats import Splats
from scene_experts.files.registry import Format
from scene_experts.geometry.sh import C0

CHUNK = 256
_RANGES = [f"{end}_{name}" for part in ("xyz", ("scale_x", "scale_y", "scale_z"), "rgb") for end in ("min", "max") for name in part]
_PACKED = ["packed_position", "packed_rotation", "packed_scale", "packed_color"]
_BITS = (11, 10, 11)
_LIMIT = 20.0  # log scales are clipped to this, as in the format's own writers


def write(path: Path, splats: Splats, note: dict[str, Any]) -> None:
    """Write the file; the note becomes a comment in the header."""
    s = splats.rows(morton_order(splats.means))
    n, chunks = len(s), -(-len(s) // CHUNK)
    parts = (
        s.means.double().numpy(),
        s.log_scales.double().numpy().clip(-_LIMIT, _LIMIT),
        s.sh[:, 0].double().numpy() * C0 + 0.5,
    )
    ranges, packed = np.empty((chunks, 18), "<f4"), np.empty((n, 4), "<u4")
    steps: list[Floats] = []
    for i, values in enumerate(parts):
        low, high = _chunk_ranges(values, chunks)
        ranges[:, 6 * i : 6 * i + 3], ranges[:, 6 * i + 3 : 6 * i + 6] = low, high
        low, span = (np.repeat(a.astype(np.float64), CHUNK, 0)[:n] for a in (low, high.astype(np.float64) - low))
        steps.append(np.where(span > 0, (values - low) / np.where(span > 0, span, 1), 0.0))
    packed[:, 0], packed[:, 2] = _pack_11_10_11(steps[0]), _pack_11_10_11(steps[1])
    packed[:, 1] = _pack_quats(unit_quats(s))
    rgba = to_bytes(np.concatenate([steps[2], alphas(s)[:, None]], 1)).astype(np.uint32)
    packed[:, 3] = rgba @ np.array([1 << 24, 1 << 16, 1 << 8, 1], np.uint32)
    rest = s.sh[:, 1:].transpose(1, 2).flatten(1).double().numpy()
    harmonics = np.clip(np.floor((rest / 8 + 0.5) * 256), 0, 255).astype(np.uint8)
    lines = ["ply", "format binary_little_endian 1.0", *(f"comment {line}" for line in note_comments(note)), f"element chunk {chunks}"]
    lines += [f"property float {name}" for name in _RANGES] + [f"element vertex {n}"] + [f"property uint {name}" for name in _PACKED]
    if rest.shape[1]:
        lines += [f"element sh {n}"] + [f"property uchar f_rest_{i}" for i in range(rest.shape[1])]
    head = "\n".join([*lines, "end_header", ""]).encode()
    write_bytes(path, head + ranges.tobytes() + packed.tobytes() + harmonics.tobytes())


def read(path: Path) -> Splats:
    """The Gaussians of a file. Raises InputError for other or damaged files."""
    with opening(path, budget.COMPRESSED_PLY) as source:
        data = source.read()
        match = re.search(rb"\nend_header[ \t]*\r?\n", data[:HEADER_LIMIT])
        if match is None:
            raise CutShort("no end of the header")
        elements = _elements(data[: match.start()].decode("ascii", "replace"), source)
        tables: dict[str, NDArray[Any]] = {}
        offset = match.end()
        for name, (count, row) in elements.items():
            if offset + count * row.itemsize > len(data):
                raise CutShort(f"{len(data):,} bytes where the header declares more")
            tables[name] = np.frombuffer(data, row, count, offset)
            offset += count * row.itemsize
        return _decode(tables).checked(path)


def _decode(tables: dict[str, NDArray[Any]]) -> Splats:
    vertex, chunk = tables["vertex"], tables["chunk"]
    n = len(vertex)
    if len(chunk) != -(-n // CHUNK):
        raise Damaged(f"{len(chunk):,} chunks for {n:,} Gaussians")
    names = _RANGES[: len(chunk.dtype.names or ())]
    column = np.stack([chunk[name] for name in names], 1).astype(np.float64) if len(chunk) else np.zeros((0, len(names)))
    if not np.isfinite(column).all():
        raise Damaged("ranges that are not finite")
    columns = np.repeat(column, CHUNK, 0)[:n]
    steps = (
        _unpack_11_10_11(vertex["packed_position"]),
        _unpack_11_10_11(vertex["packed_scale"]),
        np.stack([vertex["packed_color"] >> shift & 255 for shift in (24, 16, 8)], 1) / 255,
    )
    ends = [columns[:, i : i + 3] for i in range(0, len(names), 3)]
    values = [low * (1 - t) + high * t for low, high, t in zip(ends[::2], ends[1::2], steps)]
    values += steps[len(values) :]  # without a range, colours are from 0 to 1
    dc = (values[2] - 0.5) / C0
    sh = dc[:, None]
    if "sh" in tables:
        table = tables["sh"]
        names = sorted(table.dtype.names or (), key=lambda name: int(name.removeprefix("f_rest_")))
        levels = np.stack([table[name] for name in names], 1).astype(np.float64)
        t = np.where(levels == 0, 0.0, np.where(levels == 255, 1.0, (levels + 0.5) / 256))
        sh = np.concatenate([sh, ((t - 0.5) * 8).reshape(n, 3, len(names) // 3).transpose(0, 2, 1)], 1)
    opacity = byte_logits(vertex["packed_color"] & 255)
    return Splats(tensor(values[0]), tensor(values[1]), tensor(_unpack_quats(vertex["packed_rotation"])), tensor(opacity), tensor(sh))


def _elements(text: str, source: Source) -> dict[str, tuple[int, np.dtype[Any]]]:
    """Number of rows and row type of chunk, vertex and sh, in the order of the header."""
    found: dict[str, tuple[int, list[tuple[str, str]]]] = {}
    name = ""
    try:
        for words in (line.split() for line in text.splitlines()):
            if words[:1] == ["element"]:
                _, name, count = words
                if name in found:
                    raise ValueError
                found[name] = (parse_count(count), [])
            elif words[:1] == ["property"]:
                source.spend_items(1)
                found[name][1].append((words[2], "<" + TYPES[words[1]]))
        widths = {key: [column for column, _ in columns] for key, (_, columns) in found.items()}
        kinds = {key: {kind for _, kind in columns} for key, (_, columns) in found.items()}
        if (
            set(found) - {"sh"} != {"chunk", "vertex"}
            or "format binary_little_endian" not in text
            or sorted(widths["chunk"]) not in (sorted(_RANGES), sorted(_RANGES[:12]))
            or sorted(widths["vertex"]) != sorted(_PACKED)
            or kinds["chunk"] != {"<f4"}
            or kinds["vertex"] != {"<u4"}
            or not kinds.get("sh", set()) <= {"<u1"}
            or sorted(widths.get("sh", [])) != sorted(f"f_rest_{i}" for i in range(len(widths.get("sh", []))))
            or len(widths.get("sh", [])) not in (0, 9, 24, 45)
            or ("sh" in found and found["sh"][0] != found["vertex"][0])
        ):
            raise ValueError
    except (ValueError, KeyError, IndexError):
        raise Damaged("another layout of chunks and packed columns") from None
    return {key: (count, np.dtype(columns)) for key, (count, columns) in found.items() if columns}


def _chunk_ranges(values: Floats, chunks: int) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Minimum and maximum of each chunk, [chunks, 3] each."""
    if not chunks:
        return np.zeros((0, 3), np.float32), np.zeros((0, 3), np.float32)
    starts = np.arange(chunks) * CHUNK
    return np.minimum.reduceat(values, starts).astype(np.float32), np.maximum.reduceat(values, starts).astype(np.float32)


def _pack_11_10_11(steps: Floats) -> NDArray[np.uint32]:
    x, y, z = (np.clip(np.floor(steps[:, i] * ((1 << b) - 1) + 0.5), 0, (1 << b) - 1).astype(np.uint32) for i, b in enumerate(_BITS))
    return x << np.uint32(21) | y << np.uint32(11) | z


def _unpack_11_10_11(packed: NDArray[np.uint32]) -> Floats:
    return np.stack([(packed >> 21) / 2047, (packed >> 11 & 1023) / 1023, (packed & 2047) / 2047], 1)


def _pack_quats(quats: Floats) -> NDArray[np.uint32]:
    largest, rest = smallest_three(quats)
    levels = np.clip(np.floor((rest * np.sqrt(0.5) + 0.5) * 1023 + 0.5), 0, 1023).astype(np.uint32)
    return largest.astype(np.uint32) << np.uint32(30) | levels @ np.array([1 << 20, 1 << 10, 1], np.uint32)


def _unpack_quats(packed: NDArray[np.uint32]) -> Floats:
    rest = np.stack([(packed >> shift & 1023) / 1023 for shift in (20, 10, 0)], 1)
    return from_smallest_three(packed >> 30, (rest - 0.5) * np.sqrt(2))


FORMAT = Format(
    suffix=".compressed.ply",
    write=write,
    read=read,
    marks=(b"ply",),
    looks_like=lambda path, head: b"\nelement chunk " in header(path),
    other_suffixes=(".ply",),
    antialias=True,
    is_antialiased=is_antialiased,
    read_note=read_note,
)
