"""The file of GaussianSplats3D, with or without compression (levels 0 to 2).

A header of 4,096 bytes and one of 1,024 bytes per section come before the sections. At level 0, a
Gaussian is stored in float32: position, scales, quaternion (w, x, y, z), colour and opacity in a
byte each, and harmonics of degree 2 at most, channel by channel within a degree. Levels 1 and 2
store halves, and positions in 16 bits around the centre of a bucket of Gaussians; level 2 stores
harmonics in a byte each. Full buckets come first, then the others with their lengths.
"""

from __future__ import annotations

import struct
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from scene_experts.core.reading import budget
from scene_experts.core.reading.budget import CutShort, Damaged
from scene_experts.core.reading.source import Source, opening
from scene_experts.files.formats.pack import Floats, byte_logits, check_count, decoded_bytes, tensor
from scene_experts.files.formats.splats import Splats
from scene_experts.files.registry import Format
from scene_experts.geometry.sh import C0

HEADER, SECTION = struct.Struct("<BB2x4IH14x2f4052x"), struct.Struct("<4IfH2x4IH982x")
_COMPONENTS = (0, 9, 24)  # numbers of harmonics above the constant, by degree
_KINDS = (("<f4", "<f4", "<f4"), ("<u2", "<f2", "<f2"), ("<u2", "<f2", "u1"))  # positions, scales and rotations, harmonics; by level
_RANGE, _HARMONIC = 32767, 1.5  # where a header says 0: of positions, and of harmonics in bytes


def read(path: Path) -> Splats:
    """The Gaussians of all sections, with the harmonics that every section has. Raises InputError
    for damaged files and for other versions than 0.1."""
    with opening(path, budget.KSPLAT) as source:
        data = source.read()
        if len(data) < HEADER.size:
            raise CutShort(f"{len(data):,} bytes where a header has {HEADER.size:,}")
        major, minor, sections, _, _, _, level, low, high = HEADER.unpack_from(data)
        if (major, minor) != (0, 1) or level >= len(_KINDS):
            raise Damaged(f"version {major}.{minor} and level {level} of compression")
        offset = HEADER.size + SECTION.size * sections
        if not sections or offset > len(data):
            raise CutShort(f"{len(data):,} bytes where the headers of {sections:,} sections are declared")
        parts = []
        for i in range(sections):
            part, offset = _section(source, data, HEADER.size + SECTION.size * i, offset, level, (low or -_HARMONIC, high or _HARMONIC))
            parts.append(part)
        return Splats.joined([part for part in parts if len(part)] or parts[:1]).checked(path)


def _section(source: Source, data: bytes, head: int, offset: int, level: int, ends: tuple[float, float]) -> tuple[Splats, int]:
    """The Gaussians of the section with the header at `head` and the content at `offset`, and where
    its content ends. ends: the harmonics that the bytes 0 and 255 stand for."""
    count, room, per, buckets, edge, width, scale, _, full, others, degree = SECTION.unpack_from(data, head)
    if degree >= len(_COMPONENTS) or count > room or (buckets and width != 12):
        raise Damaged(f"a section with harmonics of degree {degree}, {count:,} of {room:,} Gaussians, and {width} bytes per bucket")
    place, half, byte = _KINDS[level]
    parts = [("means", place, 3), ("scales", half, 3), ("quats", half, 4), ("rgba", "u1", 4), ("sh", byte, _COMPONENTS[degree])]
    row = np.dtype([(name, kind, (size,)) for name, kind, size in parts])
    start = offset + 4 * others + width * buckets
    if start + row.itemsize * room > len(data):
        raise CutShort(f"{len(data):,} bytes where a section of {room:,} Gaussians is declared")
    check_count(source, count, decoded_bytes(degree))
    source.spend_items(1)
    table = np.frombuffer(data, row, count, start)
    means = table["means"].astype(np.float64)
    if level:
        lengths = np.frombuffer(data, "<u4", others, offset)
        centres = np.frombuffer(data, "<f4", 3 * buckets, offset + 4 * others).reshape(-1, 3).astype(np.float64)
        scale = scale or _RANGE
        with np.errstate(over="ignore", invalid="ignore"):  # refused below
            means = (means - scale) * (edge / 2 / scale) + centres[_buckets(count, per, full, lengths, buckets)]
    scales = table["scales"].astype(np.float64)
    if not (np.isfinite(means).all() and np.isfinite(scales).all() and (scales >= 0).all()):
        raise Damaged("positions or scales that are not finite")
    splats = Splats(
        means=tensor(means),
        log_scales=tensor(np.log(np.maximum(scales, 1e-30))),
        quats=tensor(table["quats"]),
        opacity_logit=tensor(byte_logits(table["rgba"][:, 3])),
        sh=tensor(_harmonics(table, degree, ends if level == 2 else None)),
    )
    return splats, start + row.itemsize * room


def _buckets(count: int, per: int, full: int, lengths: NDArray[Any], buckets: int) -> NDArray[np.int64]:
    """The bucket [N] of each Gaussian: `full` ones with `per` Gaussians each, then those of
    `lengths`."""
    rows = np.arange(count)
    index = rows // max(per, 1)
    later = rows >= full * per
    index[later] = full + np.searchsorted(np.cumsum(lengths, dtype=np.int64), rows[later] - full * per, side="right")
    if full + len(lengths) > buckets or (count and int(index.max()) >= buckets):
        raise Damaged(f"{count:,} Gaussians that do not fit into {buckets:,} buckets")
    return index


def _harmonics(table: NDArray[Any], degree: int, ends: tuple[float, float] | None) -> Floats:
    """All harmonics [N, C, 3], with those above the constant channel by channel within a degree in
    the file."""
    sh = np.empty((len(table), (degree + 1) ** 2, 3))
    sh[:, 0] = (table["rgba"][:, :3] / 255 - 0.5) / C0
    rest = table["sh"].astype(np.float64)
    if ends is not None:
        rest = ends[0] + rest / 255 * (ends[1] - ends[0])
    for d in range(1, degree + 1):
        wide, first = 2 * d + 1, 3 * (d * d - 1)
        sh[:, d * d : (d + 1) ** 2] = rest[:, first : first + 3 * wide].reshape(-1, 3, wide).transpose(0, 2, 1)
    return sh


def looks_like(path: Path, head: bytes) -> bool:
    """Whether a file is one: by its name, or by the version and level in a header that fits into
    the file."""
    if path.suffix.lower() == ".ksplat":
        return True
    if len(head) < HEADER.size:
        return False
    major, minor, sections, *_, level, _, _ = HEADER.unpack_from(head)
    fits = 0 < sections <= path.stat().st_size // SECTION.size
    return (major, minor) == (0, 1) and level < len(_KINDS) and fits and not any(head[44 : HEADER.size])


FORMAT = Format(suffix=".ksplat", read=read, looks_like=looks_like)
