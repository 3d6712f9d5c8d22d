"""Reads members of zip archives within the budget of the file."""

from __future__ import annotations

import re
import zipfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from scene_experts.core.reading.budget import CutShort, Damaged
from scene_experts.core.reading.source import Source

_METHODS = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)
_DIRECTORY_LIMIT = 32 << 20  # bytes of the list of members, which zipfile reads at once
_TAIL = (1 << 16) + 128  # the last bytes, which say how long that list is


class Archive:
    """An open zip archive. Only stored and deflated members are read."""

    def __init__(self, source: Source, archive: zipfile.ZipFile) -> None:
        self.source, self._archive = source, archive
        source.spend_items(len(archive.filelist))
        self.names = archive.namelist()

    def read(self, name: object, limit: int) -> bytes:
        """Return the bytes of one member. Raises Damaged if it is absent, has more than `limit`
        bytes, or is beyond the budget."""
        info = self._info(name)
        if info.file_size > limit:
            raise Damaged(f"{info.file_size:,} bytes of {name!r:.60} where at most {limit:,} are expected")
        self.source.spend_bytes(info.file_size)
        with self._archive.open(info) as stream:
            data = stream.read(info.file_size + 1)
        if len(data) != info.file_size:
            raise CutShort(f"{len(data):,} bytes of {name!r:.60} where {info.file_size:,} are declared")
        return data

    def unpack(self, name: object, path: Path) -> None:
        """Write one member to `path`. Raises Damaged if it is absent or beyond the budget."""
        info = self._info(name)
        self.source.spend_bytes(info.file_size)
        left = info.file_size
        with self._archive.open(info) as stream, path.open("wb") as out:
            while part := stream.read(min(left + 1, 1 << 20)):
                left -= len(part)
                if left < 0:
                    break
                out.write(part)
                self.source.check_time()
        if left:
            raise CutShort(f"another length of {name!r:.60} than the {info.file_size:,} bytes that are declared")

    def _info(self, name: object) -> zipfile.ZipInfo:
        """The entry of a member. Raises Damaged if it is absent or cannot be unpacked here."""
        if not isinstance(name, str) or name not in self._archive.NameToInfo:
            raise Damaged(f"no member {name!r:.60}")
        info = self._archive.getinfo(name)
        if info.flag_bits & 1:
            raise Damaged(f"{name!r:.60} behind a password")
        if info.compress_type not in _METHODS:
            raise Damaged(f"{name!r:.60} in a compression that is not used here")
        self.source.check_time()
        return info


@contextmanager
def open_zip(source: Source) -> Iterator[Archive]:
    """Open the zip archive of `source`. Raises ValueError and the exceptions of zipfile, which
    `opening` turns into sentences."""
    with source.stream() as stream:
        stream.seek(max(0, source.size - _TAIL))
        tail = stream.read(_TAIL)
        sizes = [int.from_bytes(tail[at + 12 : at + 16], "little") for at in _places(tail, b"PK\x05\x06")]
        sizes += [int.from_bytes(tail[at + 40 : at + 48], "little") for at in _places(tail, b"PK\x06\x06")]  # of 64 bits
        if max(sizes, default=0) > _DIRECTORY_LIMIT:
            raise Damaged(f"a list of members of {max(sizes):,} bytes")
        with zipfile.ZipFile(stream) as archive:
            yield Archive(source, archive)


def _places(data: bytes, mark: bytes) -> list[int]:
    return [match.start() for match in re.finditer(re.escape(mark), data)]


def zip_names(source: Source) -> list[str]:
    """Return the names of the members of the zip archive of `source`."""
    with open_zip(source) as archive:
        return archive.names
