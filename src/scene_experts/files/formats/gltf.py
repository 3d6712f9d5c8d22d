"""glTF files as containers, binary and text: the JSON, buffers inside and beside it, buffer views
and accessors."""

from __future__ import annotations

import base64
import struct
from dataclasses import replace
from typing import Any
from urllib.parse import unquote

import numpy as np

from scene_experts.core.errors import InputError
from scene_experts.core.reading import budget
from scene_experts.core.reading.budget import CutShort, Damaged
from scene_experts.core.reading.numbers import whole_number
from scene_experts.core.reading.plain import parse_json
from scene_experts.core.reading.source import Source, shorten
from scene_experts.files.formats.pack import Floats

MAGIC, JSON, BIN = 0x46546C67, 0x4E4F534A, 0x004E4942
_TYPES = {5120: "i1", 5121: "u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4}
_MESHOPT = ("EXT_meshopt_compression", "KHR_meshopt_compression")


class GltfFile:
    """A file that is being read: its JSON and its buffers."""

    def __init__(self, source: Source) -> None:
        self.source = source
        self.scene, self._body = parse(source)
        self._buffers: dict[int, memoryview] = {}

    def buffer(self, index: Any) -> memoryview:
        """The bytes of a buffer: the binary chunk, base64 in the JSON, or a file in the same
        folder."""
        number = whole_number(index, "a buffer")
        if number not in self._buffers:
            uri = self.scene.get("buffers", [{}])[number].get("uri")
            if uri is None and number == 0 and self._body:
                self._buffers[number] = self._body
            elif not isinstance(uri, str):
                raise Damaged(f"a buffer {number} without content")
            elif uri.startswith("data:"):
                kind, _, text = uri.partition(",")
                if not kind.endswith(";base64"):
                    raise Damaged(f"a buffer {number} that is not base64")
                self.source.spend_bytes(2 * len(text))
                self._buffers[number] = memoryview(base64.b64decode(text, validate=True))
            elif "://" in uri:
                raise InputError(
                    f"expected the buffers of {self.source.path} in it or beside it, found {shorten(uri, 80)}; download that file beside it"
                )
            else:
                self._buffers[number] = memoryview(self.source.part(unquote(uri)))
        return self._buffers[number]

    def view(self, index: Any) -> dict[str, Any]:
        """The entry of a buffer view."""
        view = self.scene["bufferViews"][whole_number(index, "a buffer view")]
        packed = [name for name in _MESHOPT if name in view.get("extensions", {})]
        if packed:
            raise Damaged(f"a buffer view compressed by {packed[0]}")
        return view

    def content(self, index: Any) -> bytes:
        """The bytes of a buffer view."""
        view = self.view(index)
        data = self.buffer(view.get("buffer", 0))
        start, size = whole_number(view.get("byteOffset", 0), "an offset"), whole_number(view["byteLength"], "a length")
        if start + size > len(data):
            raise CutShort(f"buffer view {index}, which reaches beyond the file")
        self.source.check_time()
        return bytes(data[start : start + size])

    def accessor(self, index: Any) -> Floats:
        """The values [N, C] of an accessor; normalised integers become fractions."""
        accessor = self.scene["accessors"][whole_number(index, "an accessor")]
        if "bufferView" not in accessor:
            needed = ", ".join(str(name) for name in self.scene.get("extensionsUsed", []) if name != "KHR_gaussian_splatting")
            raise Damaged(f"accessor {index} without data, which another extension may hold ({needed or 'none is named'})")
        view = self.view(accessor["bufferView"])
        data = self.buffer(view.get("buffer", 0))
        item, width = np.dtype(_TYPES[accessor["componentType"]]), WIDTHS[accessor["type"]]
        count = whole_number(accessor["count"], f"the count of accessor {index}")
        stride = whole_number(view.get("byteStride", item.itemsize * width), f"a stride of accessor {index}", item.itemsize * width)
        start = sum(whole_number(part.get("byteOffset", 0), f"an offset of accessor {index}") for part in (view, accessor))
        last = start + stride * (count - 1) + item.itemsize * width if count else start
        if "sparse" in accessor:
            raise Damaged(f"sparse values in accessor {index}")
        if last > len(data):
            raise CutShort(f"accessor {index}, which reaches beyond the file")
        self.source.spend_items(1)
        self.source.spend_bytes(8 * count * width)  # several accessors may name the same bytes
        rows = np.ndarray((count, width), item, data, start, (stride, item.itemsize))
        if accessor.get("normalized"):
            return np.maximum(rows / float(np.iinfo(item).max), -1.0)
        with np.errstate(invalid="ignore"):  # the caller refuses values that are not finite
            return rows.astype(np.float64)


def parse(source: Source) -> tuple[dict[str, Any], memoryview]:
    """The JSON and the binary chunk of a file; an empty chunk for a text file."""
    data = memoryview(source.read())
    if bytes(data[:4]) != b"glTF":
        return parse_text(bytes(data)), memoryview(b"")
    if len(data) < 20 or struct.unpack_from("<II", data) != (MAGIC, 2):
        raise CutShort("no whole header") if len(data) < 20 else Damaged("another header")
    length = struct.unpack_from("<I", data, 8)[0]
    size, kind = struct.unpack_from("<II", data, 12)
    if length > len(data) or kind != JSON or 20 + size > len(data):
        raise CutShort(f"{len(data):,} bytes where the header declares {length:,}")
    scene = parse_text(bytes(data[20 : 20 + size]))
    start = 20 + size
    if len(data) < start + 8:
        return scene, memoryview(b"")
    size, kind = struct.unpack_from("<II", data, start)
    body = data[start + 8 : start + 8 + size]
    if kind != BIN or len(body) != size:
        raise CutShort("a binary chunk that was cut short")
    return scene, body


def parse_text(text: bytes) -> dict[str, Any]:
    """The JSON of a file, which may hold buffers as base64."""
    if sum(text.count(mark) for mark in (b",", b"[", b"{")) > budget.META.items:
        raise Damaged(f"more than {budget.META.items:,} values")
    scene = parse_json(text, replace(budget.META, bytes_in=budget.GLB.bytes_in))
    if not isinstance(scene, dict):
        raise Damaged("a description that is not an object")
    return scene
