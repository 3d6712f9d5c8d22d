"""Atomic file writes, and lock files."""

from __future__ import annotations

import errno
import json
import logging
import os
import sys
import tempfile
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from filelock import FileLock, Timeout

from scene_experts.core.errors import InputError, RunError
from scene_experts.core.reading.plain import read_json as read_json

log: logging.Logger = logging.getLogger(__name__)


def write_atomic(path: Path, write: Callable[[Path], object], sync: bool = True) -> None:
    """Write a file atomically: `write(temporary)` writes to a temporary file beside `path`, which
    then replaces `path`.

    With `sync` the data is synced to disk first, so after a crash or a power failure `path` is
    either the old file or the new one. Raises RunError if the disk is full or not writable. The old
    file is then unchanged and the temporary file is removed.
    """
    path = Path(path)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        handle, name = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.", suffix=".part")
        os.close(handle)
    except OSError as error:
        raise _unwritable(path, error) from error
    temporary = Path(name)
    try:
        write(temporary)
        if sync:
            with temporary.open("rb+") as stream:
                os.fsync(stream.fileno())
        temporary.chmod(new_file_mode(0o666))
        os.replace(temporary, path)
    except OSError as error:
        raise _unwritable(path, error) from error
    finally:
        temporary.unlink(missing_ok=True)


_PLACE = (
    errno.ENOENT,
    errno.ENOTDIR,
    errno.EISDIR,
    errno.EEXIST,
    errno.EACCES,
    errno.EPERM,
    errno.EROFS,
)  # errors of the path, not of free space
_NO_LOCKS = (errno.ENOLCK, errno.ENOSYS, errno.ENOTSUP)  # of a file system without locks


def _unwritable(path: Path, error: OSError, option: str = "") -> RunError:
    advice = "choose" if error.errno in _PLACE else "free some space or choose"
    return RunError(f"cannot write {path}: {error.strerror or error}; {advice} another folder{f' with {option}' if option else ''}")


def check_writable(path: Path, option: str = "--out") -> None:
    """Create the folder of `path`, which `option` has named, and check that files can be created in
    it. Call it before long work.

    Raises RunError if not.
    """
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=path.parent):
            pass
    except OSError as error:
        raise _unwritable(path, error, option) from error


@contextmanager
def locked(path: Path, busy: str) -> Iterator[None]:
    """Hold the lock file `path`. The lock ends with the process. Raises InputError(busy) if another
    process holds it."""
    lock = _make_lock(path)
    try:
        lock.acquire(blocking=False)
    except Timeout:
        raise InputError(busy) from None
    except (NotImplementedError, OSError) as error:
        if isinstance(error, OSError) and error.errno not in _NO_LOCKS:
            raise _unwritable(path, error) from error
        log.warning("%s is on a file system without locks; do not use this folder from two processes at once", path.parent)
        yield
        return
    try:
        yield
    finally:
        lock.release()


@contextmanager
def waiting(path: Path) -> Iterator[None]:
    """Hold the lock file `path` for a moment; wait while another process holds it. Raises RunError
    after a minute."""
    lock = _make_lock(path)
    try:
        lock.acquire(timeout=60)
    except Timeout:
        raise RunError(f"cannot write beside {path}: another process has held this lock for a minute; end it") from None
    except (NotImplementedError, OSError) as error:
        if isinstance(error, OSError) and error.errno not in _NO_LOCKS:
            raise _unwritable(path, error) from error
        yield  # a file system without locks
        return
    try:
        yield
    finally:
        lock.release()


def _make_lock(path: Path) -> FileLock:
    """Return a lock of the system. Newer versions of filelock would replace a missing one by a
    file, which outlives a killed process."""
    try:
        return FileLock(path, fallback_to_soft=False)
    except TypeError:
        return FileLock(path)


_UMASK = threading.Lock()


def new_file_mode(most: int) -> int:
    """Return the permissions of a new file or folder: `most` without the bits of the umask.
    Temporary files are created with fewer."""
    with _UMASK:  # it is the process's
        umask = os.umask(0)
        os.umask(umask)
    return most & ~umask


def cache_dir() -> Path:
    """Return the cache folder of scene-experts for the current user."""
    if sys.platform == "win32":
        root = Path(os.environ.get("LOCALAPPDATA") or Path.home() / "AppData" / "Local")
    elif sys.platform == "darwin":
        root = Path.home() / "Library" / "Caches"
    else:
        root = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
    return root / "scene-experts"


def write_bytes(path: Path, data: bytes) -> None:
    """Write `data` to `path` atomically."""
    write_atomic(path, lambda temporary: temporary.write_bytes(data))


def write_json(path: Path, value: Any) -> None:
    """Write `value` as indented JSON to `path` atomically. Raises ValueError for NaN and infinity,
    which JSON does not support."""
    write_bytes(path, (json.dumps(value, indent=2, allow_nan=False) + "\n").encode())
