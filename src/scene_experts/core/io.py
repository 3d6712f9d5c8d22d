"""Files written whole or not at all, and locks."""

from __future__ import annotations

import errno
import json
import os
import sys
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from filelock import FileLock, Timeout

from scene_experts.core.errors import InputError, RunError


def write_atomic(path: Path, write: Callable[[Path], object]) -> None:
    """Let `write(temporary)` make a file beside `path`, then move it onto `path` in one step.

    The bytes are synced before the move, so after a crash or a power cut `path` is either the old file or the new one.
    Raises RunError (the old file untouched, the temporary removed) when the disk is full or not writable.
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
)  # the place's fault, not its room's


def _unwritable(path: Path, error: OSError) -> RunError:
    advice = "choose" if error.errno in _PLACE else "free some space or choose"
    return RunError(f"cannot write {path}: {error.strerror or error}; {advice} another folder with --out")


def check_writable(path: Path) -> None:
    """Make the folder of `path` and see that a file can be made there, before long work is done for it. Raises RunError where it cannot."""
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=path.parent):
            pass
    except OSError as error:
        raise _unwritable(path, error) from error


@contextmanager
def locked(path: Path, busy: str) -> Iterator[None]:
    """Hold the lock file `path` for this process; one that dies lets go. Raises InputError(busy) where another holds it."""
    lock = FileLock(path)
    try:
        lock.acquire(blocking=False)
    except Timeout:
        raise InputError(busy) from None
    except NotImplementedError:  # some network file systems know no locks
        yield
        return
    try:
        yield
    finally:
        lock.release()


def new_file_mode(most: int) -> int:
    """The permissions of a new file or folder: `most` less what this process's umask takes away; temporaries are made with fewer."""
    umask = os.umask(0)
    os.umask(umask)
    return most & ~umask


def cache_dir() -> Path:
    """This user's cache folder of the project."""
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
    """Write `value` as indented JSON to `path` atomically. NaN is refused: JSON has no word for it."""
    write_bytes(path, (json.dumps(value, indent=2, allow_nan=False) + "\n").encode())


def read_json(path: Path, what: str) -> Any:
    """The JSON in `path`. `what` names it in the error, e.g. "run configuration"."""
    path = Path(path)
    try:
        return json.loads(path.read_bytes())  # UTF-8 whatever the locale, with or without a mark at its beginning
    except FileNotFoundError as error:
        raise InputError(f"expected a {what} at {path}, found no such file; check the path") from error
    except (json.JSONDecodeError, UnicodeDecodeError) as error:
        raise InputError(
            f"expected a {what} in JSON at {path}, found something unreadable ({error}); restore or remove the file"
        ) from error
