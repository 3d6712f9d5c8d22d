"""One scene out of a zip or tar archive of many: only plain files below the wanted folder, within bounds, whole or not at all."""

from __future__ import annotations

import gzip
import lzma
import shutil
import stat
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
from scene_experts.data.fetch.download import Progress

MOST_BYTES = 64 << 30  # of one scene; the largest of the catalog has about 3 GB
MOST_FILES = 100_000
SPARE = 64 << 20  # bytes of disk left free
_DAMAGE = (zipfile.BadZipFile, tarfile.TarError, gzip.BadGzipFile, zlib.error, lzma.LZMAError)
_CLUTTER = ("__MACOSX", ".DS_Store")


@dataclass(frozen=True)
class Member:
    """An entry of an archive. Names are as the archive states them: not to be trusted."""

    name: str
    bytes: int
    kind: Literal["file", "folder", "other"]  # other: links and devices
    open: Callable[[], IO[bytes]]


@dataclass(frozen=True)
class Extracted:
    """What came out: the folder inside the archive, and how much."""

    inside: str
    files: int
    bytes: int


@contextmanager
def members(archive: Path) -> Iterator[list[Member]]:
    """The entries of a zip or tar archive (of any compression), readable while the context lasts. Raises RunError for another file."""
    try:
        if zipfile.is_zipfile(archive):
            with zipfile.ZipFile(archive) as opened:
                yield [_from_zip(opened, info) for info in opened.infolist()]
            return
        with tarfile.open(archive) as opened:
            yield [_from_tar(opened, info) for info in opened.getmembers()]
    except (*_DAMAGE, EOFError, NotImplementedError) as error:
        reason = str(error).partition("\n")[0].rstrip(":")
        raise RunError(
            f"expected a whole zip or tar archive at {archive}, found a damaged one ({reason}); remove it and run the command again"
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


def extract(archive: Path, scene: str, into: Path, inside: Sequence[str] = (), progress: Progress | None = None) -> Extracted:
    """Write the files of `scene` to the folder `into`, which appears whole or not at all.

    inside: where in the archive it is expected, e.g. "tandt/truck"; else the one folder of that name which holds `images`.
    progress: told bytes so far and in all. Raises RunError for damage, a link or a name that leads outside, more than MOST_BYTES or
    MOST_FILES, too small a disk, or an archive without the scene.
    """
    with members(archive) as entries:
        prefix = find(entries, scene, inside, archive)
        wanted = [(parts, m) for m in entries if (parts := _below(m.name, prefix)) and m.kind != "folder" and not _clutter(parts)]
        total = _check(wanted, archive)
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


def _copy(source: IO[bytes], stream: IO[bytes], member: Member, done: int, total: int, progress: Progress | None) -> int:
    """Copy one entry, never more than it says it holds; a zip's checksums are verified on the way."""
    left = member.bytes
    while block := source.read(min(1 << 20, left + 1)):
        left -= len(block)
        if left < 0:
            raise EOFError(f"{member.name} is longer than it says")
        stream.write(block)
        done += len(block)
        if progress:
            progress(done, total)
    if left:
        raise EOFError(f"{member.name} ends early")
    return done


def find(entries: Sequence[Member], scene: str, inside: Sequence[str], archive: Path) -> tuple[str, ...]:
    """The folder of `scene` as parts of its path: one of `inside` if it is there, else the only folder of that name that holds images."""
    folders = {parts[: parts.index("images")] for m in entries if "images" in (parts := _parts(m.name))}
    for place in inside:
        if _parts(place) in folders:
            return _parts(place)
    found = sorted(f for f in folders if f and f[-1].lower() == scene.lower())
    if len(found) == 1:
        return found[0]
    names = ", ".join(sorted({f[-1] for f in folders if f})[:20]) or "no folder that holds images"
    raise RunError(
        f"expected one folder {scene} that holds images in {archive.name}, found {len(found) or names}; "
        f"the archive has changed: extract the scene by hand (see `scene-experts catalog {scene}`)"
    )


def _check(wanted: Sequence[tuple[tuple[str, ...], Member]], archive: Path) -> int:
    """Bytes of the entries `wanted`. Raises RunError for one that cannot be trusted."""

    def refuse(found: str) -> RunError:
        return RunError(f"expected plain files of a scene in {archive.name}, found {found}; do not trust this archive: remove it")

    seen: set[str] = set()
    for parts, member in wanted:
        if member.kind == "other":
            raise refuse(f"a link, a device or an encrypted file ({member.name})")
        if any(part in ("..", ".") or "\\" in part or ":" in part or "\0" in part for part in parts):
            raise refuse(f"a name that leads elsewhere ({member.name})")
        name = "/".join(parts)
        if name in seen:
            raise refuse(f"two files of one name ({member.name})")
        seen.add(name)
    total = sum(member.bytes for _, member in wanted)
    if total > MOST_BYTES or len(wanted) > MOST_FILES:
        raise refuse(f"{len(wanted):,} files of {total / 1e9:,.0f} GB, where {MOST_FILES:,} and {MOST_BYTES / 1e9:.0f} GB are the most")
    return total


def _expect_room(into: Path, total: int) -> None:
    into.parent.mkdir(parents=True, exist_ok=True)
    free = shutil.disk_usage(into.parent).free
    if total + SPARE > free:
        raise RunError(
            f"expected {(total + SPARE) / 1e9:.1f} GB free at {into.parent} to unpack {into.name}, found {free / 1e9:.1f} GB; "
            f"free some space or choose another folder"
        )


def _parts(name: str) -> tuple[str, ...]:
    """The parts of a name; a leading "./" and doubled slashes do not count."""
    parts = tuple(part for part in name.split("/") if part)
    return parts[1:] if parts[:1] == (".",) else parts


def _below(name: str, prefix: tuple[str, ...]) -> tuple[str, ...]:
    """The rest of `name` below the folder `prefix`, or nothing where it is not below."""
    parts = _parts(name)
    return parts[len(prefix) :] if parts[: len(prefix)] == prefix else ()


def _clutter(parts: tuple[str, ...]) -> bool:
    return any(part in _CLUTTER or part.startswith("._") for part in parts)
