"""Opens a foreign file within its budget, and turns whatever fails in its reader into one
InputError."""

from __future__ import annotations

import json
import logging
import os
import stat
import struct
import time
import zipfile
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO

from scene_experts.core.errors import InputError, RunError
from scene_experts.core.reading.budget import BYTES_PER_SECOND, Budget, CutShort, Damaged

log: logging.Logger = logging.getLogger(__name__)
_LONGEST, _LONGEST_SENTENCE = 160, 2000  # characters of a cause in an error message, and of a message


class Source:
    """A file that is being read, and what its reader has used of the budget so far."""

    path: Path
    budget: Budget
    size: int

    def __init__(self, path: Path, budget: Budget, size: int) -> None:
        self.path, self.budget, self.size = path, budget, size
        self.memory = self.items = 0
        self._parts: dict[str, bytes] = {}
        self._end = time.thread_time() + budget.time_limit(size)

    def read(self) -> bytes:
        """Return the whole file. Raises Damaged if it has grown since it was opened."""
        with self.path.open("rb") as stream:
            data = stream.read(self.size + 1)
        if len(data) > self.size:
            raise CutShort("a file that grows while it is read")
        return data

    def head(self, most: int) -> bytes:
        """Return the first `most` bytes, or the whole file if it is shorter."""
        with self.path.open("rb") as stream:
            return stream.read(most)

    def stream(self) -> IO[bytes]:
        """Open the file for reading. The caller closes it."""
        return self.path.open("rb")

    def part(self, name: object, limit: int | None = None) -> bytes:
        """Return the bytes of another file of the same scene, which this file names: a name inside
        its folder. Its size widens the budget of bytes and time. Raises Damaged for other names and
        for more than `limit` bytes, and InputError for an absent file."""
        path = inside(self.path.parent, name)
        key = os.path.realpath(path)
        if key not in self._parts:  # each file once, whatever it is called
            self.spend_items(1)
            with opening(path, self.budget, f"part of {self.path.name}") as other:
                if limit is not None and other.size > limit:
                    raise Damaged(f"{other.size:,} bytes where at most {limit:,} are expected")
                self._parts[key] = other.read()
            self.size += other.size
            self._end += other.size / BYTES_PER_SECOND
            self.spend_bytes(other.size)
        return self._parts[key]

    def spend_bytes(self, count: float) -> None:
        """Announce that the reader will take `count` more bytes of memory. Raises Damaged beyond
        the budget. Call it first."""
        self.memory += max(0, int(count))
        if self.memory > self.budget.allowance(self.size):
            raise Damaged(f"{self.size:,} bytes that unpack to {self.memory:,}")

    def spend_items(self, count: int) -> None:
        """Announce `count` more items. Raises Damaged beyond the budget of items or time."""
        self.items += max(0, count)
        if self.items > self.budget.items:
            raise Damaged(f"more than {self.budget.items:,} items")
        self.check_time()

    def check_time(self) -> None:
        """Raise Damaged if the reader has used up its time, in seconds of the processor: a busy
        machine is not the fault of a file."""
        if time.thread_time() > self._end:
            raise Damaged(f"content that takes longer than {self.budget.time_limit(self.size):.0f} s to read")


@contextmanager
def opening(path: Path, budget: Budget, what: str | None = None) -> Iterator[Source]:
    """Open `path` for a reader: `with opening(path, budget.SPZ) as source`.

    `what` replaces the budget's name of the file in messages. Raises InputError, in one sentence,
    if the file is absent, is not a regular file, is larger than its budget, or if the block fails
    with any exception but an InputError or RunError of its own.
    """
    path = Path(path)
    with guarding(path, budget, what):
        try:
            found = path.stat()
        except (FileNotFoundError, NotADirectoryError):
            raise InputError(f"expected {article(what or budget.what)} at {path}, found no such file; check the path") from None
        if not stat.S_ISREG(found.st_mode):
            kind = "a folder" if stat.S_ISDIR(found.st_mode) else "no regular file"
            raise InputError(f"expected {article(what or budget.what)} at {path}, found {kind}; check the path")
        if found.st_size > budget.bytes_in:
            raise Damaged(f"{found.st_size:,} bytes, more than the {budget.bytes_in:,} that are read")
        yield Source(path, budget, found.st_size)


@contextmanager
def guarding(path: Path | str, budget: Budget, what: str | None = None) -> Iterator[None]:
    """Turn every exception of a block that interprets the content of `path` into one InputError;
    InputError and RunError pass."""
    try:
        yield
    except InputError as error:
        if (text := sentence(error)) != str(error):  # it quotes the file
            raise InputError(text) from error
        raise
    except RunError:
        raise
    except OSError as error:
        if error.errno is None:  # raised by a decoder for damaged content, not by the system
            raise damaged_error(path, budget, error, what) from error
        raise InputError(f"cannot read {path}: {error.strerror or error}; check the file and its permissions") from error
    except Exception as error:
        if type(error).__name__ == "OutOfMemoryError":  # of a GPU: the file is not at fault
            raise
        if not isinstance(error, Damaged):
            log.debug("could not read %s", path, exc_info=True)
        raise damaged_error(path, budget, error, what) from error
    except BaseException as error:
        if type(error).__name__ != "PanicException":  # a failed assertion in a library written in Rust
            raise
        raise damaged_error(path, budget, error, what) from error


def damaged_error(path: Path | str, budget: Budget, error: BaseException, what: str | None = None) -> InputError:
    """Return the error for a file whose content does not fit its format. Only a file that may lack
    bytes is called not whole."""
    name, found = what or budget.what, describe(error)
    if is_cut(error) or not budget.other:
        return InputError(f"expected {article('whole ' + name)} at {path}, found {found}; {budget.advice}")
    return InputError(f"expected {article(name)} that this version reads at {path}, found {found}; {budget.other}")


def is_cut(error: BaseException) -> bool:
    """Return whether a failure is that of a file that lacks bytes or has lost some: another copy
    may help."""
    if isinstance(error, json.JSONDecodeError):
        return error.msg.startswith("Unterminated") or not error.doc[error.pos :].strip()
    names = ("SafetensorError", "ZstdError")  # of libraries that this module does not import
    return isinstance(error, (CutShort, EOFError, OSError, struct.error, zlib.error, zipfile.BadZipFile)) or type(error).__name__ in names


def describe(error: BaseException) -> str:
    """Return the cause of a failure in a few words on one line."""
    if isinstance(error, MemoryError):
        return "content that takes more memory than there is"
    if isinstance(error, RecursionError):
        return "content that is nested too deeply"
    if type(error).__name__ == "UnidentifiedImageError":
        return "content that is no picture of a known format"
    text = shorten(str(error).strip())
    if isinstance(error, Damaged):
        return text
    if isinstance(error, KeyError) and error.args and isinstance(error.args[0], str):
        return f"content without {text}"
    return f"content that does not fit together ({text or type(error).__name__})"


def sentence(text: object) -> str:
    """Return a message in a form that a terminal can show: as it is, or `shorten`ed if it is very
    long or quotes unprintable characters."""
    line = str(text)
    return line if line.isprintable() and len(line) <= _LONGEST_SENTENCE else shorten(line, _LONGEST_SENTENCE)


def shorten(text: str, most: int = _LONGEST) -> str:
    """Return the text on one line, cut after `most` characters, with unprintable characters
    replaced."""
    line = "".join(c if c.isprintable() else " " for c in text[: 4 * most])
    line = " ".join(line.split())
    return line if len(line) <= most else line[: most - 3] + "..."


def article(noun: str) -> str:
    """Return the noun with its indefinite article."""
    return f"{'an' if noun[:1].lower() in 'aeiou' or noun[:3] in ('SPZ', 'SOG', 'htm') else 'a'} {noun}"


def inside(folder: Path, name: object) -> Path:
    """Return the path of `name` in `folder`. Raises Damaged unless it is the name of a place inside
    that folder.

    Files name other files; such a name must not lead out of its folder by "..", an absolute path or
    a symbolic link.
    """
    if not isinstance(name, str) or not name or "\0" in name or len(name) > 4096:
        raise Damaged(f"{shorten(repr(name), 60)} where the name of a file is expected")
    path = folder / name
    real, root = os.path.realpath(path), os.path.realpath(folder)
    if os.path.isabs(name) or os.path.commonpath([real, root]) != root:
        raise Damaged(f"the name {shorten(name, 60)!r}, which leads out of its folder")
    return path
