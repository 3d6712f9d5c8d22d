"""The bytes of a compact file: mark, header, parts, checksum.

8 bytes    the mark "SXCOMP2" and a line feed
4 bytes    length of the header, little endian
header     JSON, deflated (zlib); "parts" lists names and lengths of the parts, in order
parts
4 bytes    CRC-32 of everything before, little endian
"""

from __future__ import annotations

import json
import zlib
from collections.abc import Mapping
from typing import Any

from scene_experts.core.reading.budget import META as HEADER
from scene_experts.core.reading.budget import CutShort, Damaged
from scene_experts.core.reading.numbers import whole_number
from scene_experts.core.reading.plain import parse_json

MARK = b"SXCOMP2\n"
_LENGTH = 4  # bytes of a number


def join(header: Mapping[str, Any], parts: Mapping[str, bytes], mark: bytes = MARK) -> bytes:
    """The bytes of a file. header: JSON values without "parts"; mark: 8 bytes."""
    listed = {**header, "parts": [[name, len(part)] for name, part in parts.items()]}
    text = zlib.compress(json.dumps(listed, allow_nan=False, separators=(",", ":")).encode(), 9)
    data = b"".join([mark, len(text).to_bytes(_LENGTH, "little"), text, *parts.values()])
    return data + zlib.crc32(data).to_bytes(_LENGTH, "little")


def part(data: bytes, mark: bytes = MARK) -> tuple[dict[str, Any], dict[str, bytes]]:
    """The header and the parts by name of the bytes of a file.

    Raises CutShort for bytes that lack some or whose checksum is wrong, and Damaged for others.
    """
    if not data.startswith(mark):
        raise Damaged("no compact scene")
    start = len(mark) + _LENGTH
    if len(data) < start + _LENGTH or zlib.crc32(data[:-_LENGTH]) != int.from_bytes(data[-_LENGTH:], "little"):
        raise CutShort("bytes with another checksum")
    at = start + int.from_bytes(data[len(mark) : start], "little")
    machine = zlib.decompressobj()
    text = machine.decompress(data[start:at], HEADER.bytes_in + 1)
    if not machine.eof or len(text) > HEADER.bytes_in:
        raise Damaged("a header that is too long")
    header: Any = parse_json(text, HEADER)
    listed = header.pop("parts")
    parts: dict[str, bytes] = {}
    for name, length in listed:
        size = whole_number(length, "the length of a part", 0, len(data))
        parts[str(name)] = data[at : at + size]
        at += size
    if at != len(data) - _LENGTH or len(parts) != len(listed):
        raise Damaged("parts of another length than the file")
    return header, parts
