"""Reads the vertices of PLY files: ascii and both binary byte orders."""

from __future__ import annotations

import io
import re
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from scene_experts.core.reading.budget import CutShort, Damaged
from scene_experts.core.reading.source import Source

HEADER_LIMIT = 1 << 20
TYPES = {
    "char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1", "short": "i2", "int16": "i2", "ushort": "u2", "uint16": "u2",
    "int": "i4", "int32": "i4", "uint": "u4", "uint32": "u4", "float": "f4", "float32": "f4", "double": "f8", "float64": "f8",
}  # fmt: skip
_ORDERS = {"binary_little_endian": "<", "binary_big_endian": ">", "ascii": "="}
_MOST_ROWS = 1 << 40


@dataclass(frozen=True)
class Header:
    """The header of a PLY file as far as its vertices go."""

    text: str
    start: int  # offset of the data in bytes
    ascii: bool
    count: int  # of vertices
    fields: tuple[tuple[str, str], ...]  # name and numpy type of each property, in the order of the file

    @property
    def row(self) -> np.dtype[np.void]:
        """The type of one vertex."""
        return np.dtype(list(self.fields))


def read_header(source: Source) -> Header:
    """Parse the header. Raises Damaged unless its first element is `vertex`, with scalar properties
    of known types."""
    head = source.head(HEADER_LIMIT)
    match = re.search(rb"\nend_header[ \t]*\r?\n", head)
    if not head.startswith(b"ply") or match is None:
        raise Damaged("something that is no PLY file")
    text = head[: match.start()].decode("ascii", "replace")
    order, count, fields, element = "", -1, [], ""
    lines = text.splitlines()
    source.spend_items(sum(line.startswith(("property", "element")) for line in lines))
    for words in (line.split() for line in lines):
        match words:
            case ["format", kind, *_]:
                if kind not in _ORDERS:
                    raise Damaged(f"the unknown format {kind[:40]!r}")
                order = _ORDERS[kind]
            case ["element", name, number]:
                if not element and name != "vertex":
                    raise Damaged(f"a first element {name[:40]!r} where 'vertex' is expected")
                if name == "vertex" and element:
                    raise Damaged("vertices in two places")
                element = name
                count = parse_count(number) if name == "vertex" else count
            case ["property", "list", *_] if element == "vertex":
                raise Damaged("vertices with lists")
            case ["property", kind, name] if element == "vertex":
                if kind not in TYPES:
                    raise Damaged(f"the unknown type {kind[:40]!r}")
                fields.append((name, order.replace("=", "<") + TYPES[kind]))
    if not order or count < 0 or not fields or len({name for name, _ in fields}) != len(fields):
        raise Damaged("a header whose format, vertices or properties are missing or named twice")
    return Header(text, match.end(), order == "=", count, tuple(fields))


def parse_count(text: str) -> int:
    """Return a number of rows. Raises Damaged unless it is a plain decimal number in range."""
    if not re.fullmatch(r"[0-9]{1,18}", text):
        raise Damaged(f"{text[:40]!r} as a number of rows")
    if int(text) > _MOST_ROWS:
        raise Damaged(f"{int(text):,} rows")
    return int(text)


def read_table(source: Source, header: Header) -> NDArray[Any]:
    """Return the vertices: a structured array [N] for binary files, float64 [N, C] for ascii files.

    Raises Damaged if there are fewer vertices than the header declares.
    """
    if header.ascii:
        return read_ascii(source, header)
    row = header.row
    room = max(0, source.size - header.start) // row.itemsize
    if room < header.count:
        raise CutShort(f"{room:,} vertices where {header.count:,} are declared: the file was cut short")
    return np.fromfile(source.path, row, header.count, offset=header.start)


def read_ascii(source: Source, header: Header) -> NDArray[np.float64]:
    """Return the numbers [N, C] of an ascii file."""
    width = len(header.fields)
    if header.count * (2 * width) > source.size - header.start + 1:  # a digit and a separator each
        raise CutShort(f"fewer vertices than the {header.count:,} that are declared: the file was cut short")
    out = np.empty((header.count, width), np.float64)
    with source.stream() as stream:
        stream.seek(header.start)
        done = 0
        while done < header.count:
            lines, want = [], min(header.count - done, 65_536)
            while len(lines) < want:
                line = stream.readline(64 * width + 64)
                if not line:
                    raise CutShort(f"{done + len(lines):,} vertices where {header.count:,} are declared: the file was cut short")
                if line.strip():
                    lines.append(line.decode("ascii"))
            part = np.loadtxt(io.StringIO("".join(lines)), np.float64, comments=None, ndmin=2)
            if part.shape != (want, width):
                raise Damaged(f"lines of {part.shape[1]} numbers where {width} are expected")
            out[done : done + want] = part
            done += want
            source.check_time()
    return out
