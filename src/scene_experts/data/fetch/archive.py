"""Extracts one scene from a zip or tar archive: only plain files of the wanted folder, within size
limits, all of them or none."""

from __future__ import annotations

import gzip
import lzma
import shutil
import stat
import struct
import tarfile
import tempfile
import zipfile
import zlib
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Literal

from scene_experts.core.errors import RunError
from scene_experts.core.io import new_file_mode
from scene_experts.core.progress import ByteProgress

MOST_BYTES = 64 << 30  # per scene; the largest in the catalog has about 3 GB
MOST_FILES = 100_000
SPARE = 64 << 20  # bytes of disk left free
_DAMAGE = (zipfile.BadZipFile, tarfile.TarError, gzip.BadGzipFile, zlib.error, lzma.LZMAError)
_MALFORMED = (
    ArithmeticError,
    AssertionError,
    AttributeError,
    LookupError,
    MemoryError,
    OSError,
    RecursionError,
    TypeError,
    ValueError,
    struct.error,
)
"""What zipfile and tarfile raise for archives that they do not expect."""
_CLUTTER = ("__MACOSX", ".DS_Store")


@dataclass(frozen=True)
class Member:
    """An entry of an archive. Its name comes from the archive and is not trusted."""

    name: str
    bytes: int
    kind: Literal["file", "folder", "other"]  # other: links and devices
    open: Callable[[], IO[bytes]]


@dataclass(frozen=True)
class Extracted:
    """The folder inside the archive that was extracted, and its size."""

    inside: str
    files: int
    bytes: int


@contextmanager
def open_archive(archive: Path) -> Iterator[list[Member]]:
    """Open a zip or tar archive of any compression and yield its entries. Raises RunError if the
    file is damaged or something else."""
    try:
        if zipfile.is_zipfile(archive):
            with zipfile.ZipFile(archive) as opened:
                yield [_from_zip(opened, info) for info in opened.infolist()]
            return
        with tarfile.open(archive) as opened:
            yield [_from_tar(opened, info) for info in opened.getmembers()]
    except (*_DAMAGE, *_MALFORMED, EOFError, NotImplementedError) as error:
        reason = "".join(c for c in str(error).partition("\n")[0] if c.isprintable()).rstrip(":")[:200] or type(error).__name__
        raise RunError(
            f"expected a complete zip or tar archive at {archive}, found a damaged one ({reason}); remove it and run the command again"
        ) from error


def _from_zip(opened: zipfile.ZipFile, info: zipfile.ZipInfo) -> Member:
    mode = info.external_attr >> 16
    plain = stat.S_IFMT(mode) in (0, stat.S_IFREG) and not info.flag_bits & 1  # bit 0: encrypted
    return Member(info.filename, info.file_size, "folder" if info.is_dir() else "file" if plain else "other", lambda: opened.open(info))


def _from_tar(opened: tarfile.TarFile, info: tarfile.TarInfo) -> Member:
    def content() -> IO[bytes]:
        stream = opened.extractfile(info)
        assert stream is not None
        return stream

    return Member(info.name, info.size, "folder" if info.isdir() else "file" if info.isreg() else "other", content)


def extract(archive: Path, scene: str, into: Path, inside: Sequence[str] = (), progress: ByteProgress | None = None) -> Extracted:
    """Write the files of `scene` to the folder `into`. The folder appears when it is complete.

    Args:
        inside: Expected folders in the archive, e.g. "tandt/truck". Otherwise the only folder of
            that name that contains `images` is used.
        progress: Called with the bytes so far and in total.

    Raises:
        RunError: if the archive is damaged, does not contain the scene, contains a link or a name
            that leads outside the folder, exceeds MOST_BYTES or MOST_FILES, or does not fit on the
            disk.
    """
    with open_archive(archive) as entries:
        prefix = find_scene(entries, scene, inside, archive)
        wanted = [(parts, m) for m in entries if (parts := _parts_after(m.name, prefix)) and m.kind != "folder" and not _is_clutter(parts)]
        total = _check_entries(wanted, archive)
        _expect_room(into, total)
        temporary = Path(tempfile.mkdtemp(dir=into.parent, prefix=f".{into.name}.", suffix=".part"))
        try:
            done = 0
            for parts, member in wanted:
                target = temporary.joinpath(*parts)
                target.parent.mkdir(parents=True, exist_ok=True)
                with member.open() as source, target.open("xb") as stream:
                    done = _copy(source, stream, member, done, total, progress)
            temporary.chmod(new_file_mode(0o777))
            temporary.replace(into)
        except OSError as error:
            if isinstance(error, _DAMAGE):
                raise
            reason = error.strerror or error
            raise RunError(f"cannot write the scene to {into}: {reason}; free some space or choose another folder") from error
        finally:
            shutil.rmtree(temporary, ignore_errors=True)
    return Extracted("/".join(prefix), len(wanted), total)


def _copy(source: IO[bytes], stream: IO[bytes], member: Member, done: int, total: int, progress: ByteProgress | None) -> int:
    """Copy one entry, at most as many bytes as it declares. Reading a zip entry verifies its
    checksum."""
    left = member.bytes
    while block := source.read(min(1 << 20, left + 1)):
        left -= len(block)
        if left < 0:
            raise EOFError(f"{member.name} is longer than declared")
        stream.write(block)
        done += len(block)
        if progress:
            progress(done, total)
    if left:
        raise EOFError(f"{member.name} ends early")
    return done


def find_scene(entries: Sequence[Member], scene: str, inside: Sequence[str], archive: Path) -> tuple[str, ...]:
    """Return the folder of `scene` as path parts.

    It is one of `inside` if present, otherwise the only folder of that name with images.
    """
    folders = {parts[: parts.index("images")] for m in entries if "images" in (parts := _split_name(m.name))}
    for place in inside:
        if _split_name(place) in folders:
            return _split_name(place)
    found = sorted(f for f in folders if f and f[-1].lower() == scene.lower())
    if len(found) == 1:
        return found[0]
    names = ", ".join(sorted({f[-1] for f in folders if f})[:20]) or "no folder with images"
    raise RunError(
        f"expected one folder {scene} with images in {archive.name}, found {len(found) or names}; "
        f"the archive has changed, so extract the scene by hand (see `scene-experts catalog {scene}`)"
    )


def _check_entries(wanted: Sequence[tuple[tuple[str, ...], Member]], archive: Path) -> int:
    """Return the total size in bytes of the entries `wanted`. Raises RunError if one of them is not
    trustworthy."""

    def refuse(found: str) -> RunError:
        return RunError(f"expected plain files of a scene in {archive.name}, found {found}; remove this archive, it is not trustworthy")

    seen: set[str] = set()
    for parts, member in wanted:
        if member.kind == "other":
            raise refuse(f"a link, a device or an encrypted file ({member.name})")
        if any(part in ("..", ".") or "\\" in part or ":" in part or "\0" in part for part in parts):
            raise refuse(f"a name that leads outside the folder ({member.name})")
        name = "/".join(parts)
        if name in seen:
            raise refuse(f"two files with the same name ({member.name})")
        seen.add(name)
    total = sum(member.bytes for _, member in wanted)
    if total > MOST_BYTES or len(wanted) > MOST_FILES:
        raise refuse(
            f"{len(wanted):,} files of {total / 1e9:,.0f} GB (at most {MOST_FILES:,} files of {MOST_BYTES / 1e9:.0f} GB are allowed)"
        )
    return total


def _expect_room(into: Path, total: int) -> None:
    into.parent.mkdir(parents=True, exist_ok=True)
    free = shutil.disk_usage(into.parent).free
    if total + SPARE > free:
        raise RunError(
            f"expected {(total + SPARE) / 1e9:.1f} GB free at {into.parent} to unpack {into.name}, found {free / 1e9:.1f} GB; "
            f"free some space or choose another folder"
        )


def _split_name(name: str) -> tuple[str, ...]:
    """Split a name into its parts, without a leading "./" and empty parts."""
    parts = tuple(part for part in name.split("/") if part)
    return parts[1:] if parts[:1] == (".",) else parts


def _parts_after(name: str, prefix: tuple[str, ...]) -> tuple[str, ...]:
    """Return the parts of `name` after the folder `prefix`, or an empty tuple if it is not inside
    that folder."""
    parts = _split_name(name)
    return parts[len(prefix) :] if parts[: len(prefix)] == prefix else ()


def _is_clutter(parts: tuple[str, ...]) -> bool:
    return any(part in _CLUTTER or part.startswith("._") for part in parts)
