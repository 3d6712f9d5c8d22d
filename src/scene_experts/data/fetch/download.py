"""Downloads files over HTTP: resumes interrupted downloads, tries several addresses, verifies
checksums and writes atomically."""

from __future__ import annotations

import base64
import errno
import hashlib
import http.client
import json
import os
import re
import shutil
import socket
import ssl
import threading
import time
import urllib.error
import urllib.request
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from scene_experts.core.errors import InputError, RunError
from scene_experts.core.progress import ByteProgress

Say = Callable[[str], None]
TRIES = 4  # attempts without progress at one address before the next address is tried
PATIENCE = 1.0  # seconds before the second attempt; doubles with each attempt
SPARE = 64 << 20  # bytes of disk left free
MOST_BYTES = 256 << 30  # of a file whose size nobody states; the largest of the catalog has 12 GB
ANSWER = 120.0  # seconds until a server must have sent the head of its answer
SLOWEST, WINDOW = 1024, 60.0  # bytes per second that must arrive, measured over so many seconds
GAIN = 64 << 10  # bytes of progress after which an interrupted download does not count as a failed attempt


@dataclass(frozen=True)
class Fetched:
    """A downloaded file."""

    url: str
    bytes: int
    sha256: str


@dataclass(frozen=True)
class _Partial:
    """Facts about the file that a partial download belongs to. They are stored beside it."""

    url: str = ""
    version: str = ""  # the server's ETag or modification date, so that a changed file is not resumed
    md5: str = ""  # stated by the server


class _Refused(Exception):
    """The address does not serve the file, and trying again would not help."""


class _TooLong(_Refused):
    """The address sends more bytes than the file has."""


def sha256(path: Path) -> str:
    """Return the SHA-256 of a file in hexadecimal."""
    with path.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


def check_web_address(text: str) -> str:
    """Return `text`. Raises InputError unless it is an http or https address."""
    if not re.match(r"https?://[^/\s]+", text):
        raise InputError(f"expected an address that begins with http:// or https://, found '{text}'; correct the address")
    return text


def fetch(
    urls: Sequence[str],
    path: Path,
    digest: str | None = None,
    *,
    size: int | None = None,
    progress: ByteProgress | None = None,
    say: Say | None = None,
    advice: str = "",
) -> Fetched:
    """Download a file to `path` from the first of `urls` that serves it.

    An interrupted download leaves `<name>.part`, which is resumed if the server allows it. Content
    with a wrong checksum is removed.

    Args:
        digest: Expected SHA-256. Without it, only the length and the MD5 that the server states are
            verified.
        size: Expected size in bytes, if known.
        progress: Called with the bytes so far and in total (0: unknown).
        say: Called with the reason when an address is given up.
        advice: Ends the error message with what else the user can do.

    Raises:
        RunError: if no address serves the expected content or the disk is too small.
    """
    if digest and path.is_file() and sha256(path) == digest:
        return Fetched("", path.stat().st_size, digest)
    part = path.with_name(path.name + ".part")
    reasons: list[str] = []
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with _lock(part):
            if digest and part.is_file() and sha256(part) == digest:
                return _move_into_place(part, path, "", digest)
            for number, url in enumerate(urls, 1):
                try:
                    return _move_into_place(part, path, url, _download(url, part, digest, size, progress))
                except _Refused as error:
                    reasons.append(f"{url}: {error}")
                    if say and number < len(urls):
                        say(f"{reasons[-1]}; trying the next address")
    except OSError as error:
        raise RunError(f"cannot download to {path}: {error.strerror or error}; free some space or choose another folder") from error
    raise RunError(f"cannot download {'; '.join(reasons)}; run the command again to resume{advice and ', or '}{advice}")


def _move_into_place(part: Path, path: Path, url: str, found: str) -> Fetched:
    part.replace(path)
    _note_path(part).unlink(missing_ok=True)
    return Fetched(url, path.stat().st_size, found)


def _download(url: str, part: Path, digest: str | None, size: int | None, progress: ByteProgress | None) -> str:
    """Complete `part` from one address and return its SHA-256. Raises _Refused if that fails."""
    tries = 0
    while True:
        before = part.stat().st_size if part.is_file() else 0
        try:
            begun = _continue(url, part, digest is not None, size, progress)
            break
        except _TooLong:
            _remove_part(part)
            raise
        except urllib.error.HTTPError as error:
            if error.code < 500 and error.code not in (408, 429):
                raise _Refused(f"the server answered {error.code}") from error
            reason = f"the server answered {error.code}"
        except (urllib.error.URLError, http.client.HTTPException, ConnectionError, TimeoutError, ssl.SSLError) as error:
            reason = _one_line(str(getattr(error, "reason", None) or error or type(error).__name__))
        have = part.stat().st_size if part.is_file() else 0
        tries = tries + 1 if have < before + GAIN else 1
        if tries >= TRIES:
            raise _Refused(reason)
        time.sleep(PATIENCE * 2 ** (tries - 1))
    try:
        return _verify(part, begun, digest, size)
    except _Refused:
        _remove_part(part)
        raise


def _verify(part: Path, begun: _Partial, digest: str | None, size: int | None) -> str:
    """Return the SHA-256 of a complete download. Raises _Refused if its length or a checksum is
    wrong."""
    if size is not None and part.stat().st_size != size:
        raise _Refused(f"expected {size:,} bytes, found {part.stat().st_size:,}")
    if digest is None and begun.md5:
        with part.open("rb") as stream:
            found = hashlib.file_digest(stream, "md5").hexdigest()
        if found != begun.md5:
            raise _Refused(f"expected the MD5 {begun.md5[:12]}... that the server states, found {found[:12]}...")
    found = sha256(part)
    if digest and found != digest:
        raise _Refused(f"expected SHA-256 {digest[:12]}..., found {found[:12]}...")
    return found


def _continue(url: str, part: Path, known: bool, size: int | None, progress: ByteProgress | None) -> _Partial:
    """Append the missing bytes of `url` to `part`, or start over if the server sends the whole
    file.

    known: Whether the checksum is known. Then a part from another address is resumed, too, because
    the checksum is verified at the end.
    """
    have, begun = _find_resumable(url, part, known)
    headers = {"User-Agent": "scene-experts", "Accept-Encoding": "identity"}
    if have:
        headers["Range"] = f"bytes={have}-"
        if begun.url == url and begun.version:
            headers["If-Range"] = begun.version
    try:
        answer = _ask(check_web_address(url), headers)
    except urllib.error.HTTPError as error:
        if error.code != 416 or not have:  # 416: no bytes follow those we have
            raise
        if error.headers.get("Content-Range") == f"bytes */{have}" or have == size:
            return begun  # the part is complete
        _remove_part(part)
        return _continue(url, part, known, size, progress)
    with answer:
        if answer.status not in (200, 206):
            raise _Refused(f"the server answered {answer.status}")
        resumed = answer.status == 206 and (answer.headers.get("Content-Range") or f"bytes {have}-").startswith(f"bytes {have}-")
        if answer.status == 206 and not resumed:
            raise _Refused("the server sent another byte range than requested")
        have = have if resumed else 0
        total = have + _read_length(answer.headers)
        _expect_file(answer.headers.get("Content-Type") or "", total if total > have else 0, size)
        _expect_room(part, total - have)
        if not resumed:
            begun = _Partial(url, _read_version(answer.headers), _read_md5(answer.headers))
            _note_path(part).write_text(json.dumps(asdict(begun)))
        have = _append(answer, part, have, total if total > have else 0, size or MOST_BYTES, progress)
    if have < total:
        raise ConnectionError(f"the connection ended after {have} of {total} bytes")
    return begun


def _append(answer: http.client.HTTPResponse, part: Path, have: int, total: int, most: int, progress: ByteProgress | None) -> int:
    """Append the answer to `part`, at most up to `most` bytes, and return the new length.

    Raises _Refused if more bytes come, and TimeoutError if they come slower than SLOWEST.
    """
    with part.open("ab" if have else "wb") as stream:
        began, at = time.monotonic(), have
        while block := _read(answer):
            if have + len(block) > most:
                raise _TooLong(f"expected at most {most:,} bytes, found more")
            stream.write(block)
            have += len(block)
            if progress:
                progress(have, total)
            if (elapsed := time.monotonic() - began) > WINDOW:
                if have - at < SLOWEST * elapsed:
                    raise TimeoutError(f"the server sends less than {SLOWEST} bytes per second")
                began, at = time.monotonic(), have
    return have


# --- the network: whatever a server does, it ends in one of the errors that `_download` expects


class _WebRedirects(urllib.request.HTTPRedirectHandler):
    """Follows redirects to web addresses only."""

    def redirect_request(self, req, fp, code, msg, headers, newurl):
        if not re.match(r"https?://[^/\s]+", newurl):
            raise _Refused("the server redirects to something other than a web address")
        return super().redirect_request(req, fp, code, msg, headers, newurl)


def _ask(url: str, headers: dict[str, str]) -> http.client.HTTPResponse:
    """Send a request and return the answer when its head has arrived. Raises TimeoutError if that
    takes longer than ANSWER seconds."""
    sockets: list[socket.socket] = []
    over = threading.Event()

    def connect(address: tuple[str, int], timeout: float | None = None, source: tuple[str, int] | None = None) -> socket.socket:
        sockets.append(socket.create_connection(address, timeout, source))
        if over.is_set():  # `end` may have come before this socket
            sockets[-1].close()
            raise TimeoutError(f"no answer within {ANSWER:g} seconds")
        return sockets[-1]

    def end() -> None:
        over.set()
        for opened in sockets:
            with suppress(OSError):
                opened.shutdown(socket.SHUT_RDWR)

    def watched(base: type[http.client.HTTPConnection]) -> Callable[..., http.client.HTTPConnection]:
        def make(*args: Any, **options: Any) -> http.client.HTTPConnection:
            made = base(*args, **options)
            made._create_connection = connect  # type: ignore[attr-defined] - http.client keeps it for tests and tunnels
            return made

        return make

    class Http(urllib.request.HTTPHandler):
        def http_open(self, req: urllib.request.Request) -> http.client.HTTPResponse:
            return self.do_open(watched(http.client.HTTPConnection), req)  # type: ignore[arg-type]

    class Https(urllib.request.HTTPSHandler):
        def https_open(self, req: urllib.request.Request) -> http.client.HTTPResponse:
            return self.do_open(watched(http.client.HTTPSConnection), req)  # type: ignore[arg-type]

    late = threading.Timer(ANSWER, end)
    late.daemon = True
    late.start()
    try:
        with _plain_errors():
            opener = urllib.request.build_opener(Http, Https, _WebRedirects)
            return opener.open(urllib.request.Request(url, headers=headers), timeout=60)
    finally:
        late.cancel()


def _read(answer: http.client.HTTPResponse) -> bytes:
    """Return the bytes of the answer that have arrived, at least one unless it is at its end."""
    with _plain_errors():
        return answer.read1(1 << 20)


@contextmanager
def _plain_errors() -> Iterator[None]:
    """Turn what http.client and urllib raise for malformed answers (ValueError, UnicodeError,
    AssertionError...) into HTTPException."""
    try:
        yield
    except (OSError, http.client.HTTPException, _Refused):
        raise
    except Exception as error:
        raise http.client.HTTPException(f"a malformed answer ({type(error).__name__}: {error})") from error


def _one_line(text: str) -> str:
    """Return what a server said as one short line without control characters, which a terminal
    would obey."""
    return " ".join("".join(c if c.isprintable() else " " for c in text).split())[:200]


def _read_length(headers: http.client.HTTPMessage) -> int:
    """Return the length of the answer in bytes; 0 if the server does not state it as a number."""
    text = (headers.get("Content-Length") or "").strip()
    return int(text) if re.fullmatch(r"[0-9]{1,18}", text) else 0


def _find_resumable(url: str, part: Path, known: bool) -> tuple[int, _Partial]:
    """Return the number of bytes of `part` that `url` can continue (0: start over), and the facts
    about their file."""
    have = part.stat().st_size if part.is_file() else 0
    begun = _Partial()
    with suppress(OSError, ValueError, TypeError):
        begun = _Partial(**json.loads(_note_path(part).read_text()))
    same = begun.url == url and begun.version != ""
    return (have, begun) if have and (known or same) else (0, begun)


def _expect_file(kind: str, total: int, size: int | None) -> None:
    """Raise _Refused for an answer that is not the file: a web page (file moved, quota used up) or
    another length."""
    if kind.partition(";")[0].strip().lower() in ("text/html", "application/xhtml+xml"):
        raise _Refused("the server sent a web page instead of the file (the file moved, or its download quota is used up)")
    if size is not None and total and total != size:
        raise _Refused(f"expected {size:,} bytes, found {total:,}")
    if total > MOST_BYTES:
        raise _Refused(f"expected at most {MOST_BYTES:,} bytes, found {total:,}")


def _expect_room(part: Path, missing: int) -> None:
    """Raise RunError if the disk has no room for `missing` more bytes."""
    free = shutil.disk_usage(part.parent).free
    if missing + SPARE > free:
        raise RunError(
            f"expected {(missing + SPARE) / 1e9:.1f} GB free at {part.parent} for the download, found {free / 1e9:.1f} GB; "
            f"free some space or choose another folder"
        )


def _read_version(headers: http.client.HTTPMessage) -> str:
    """Return a strong ETag, otherwise the modification date, otherwise an empty string."""
    tag = headers.get("ETag") or ""
    return tag if tag.startswith('"') else headers.get("Last-Modified") or ""


def _read_md5(headers: http.client.HTTPMessage) -> str:
    """Return the MD5 of the whole file in hexadecimal if the server states it (x-goog-hash),
    otherwise an empty string."""
    for value in headers.get_all("x-goog-hash") or []:
        if found := re.search(r"md5=([A-Za-z0-9+/]{22}==)", value):
            return base64.b64decode(found[1]).hex()
    return ""


def _note_path(part: Path) -> Path:
    return part.with_name(part.name + ".json")


def _remove_part(part: Path) -> None:
    part.unlink(missing_ok=True)
    _note_path(part).unlink(missing_ok=True)


@contextmanager
def _lock(part: Path) -> Iterator[None]:
    """Hold a lock on `part`. Raises RunError while another process on this machine downloads the
    same file."""
    try:
        import fcntl
    except ImportError:  # Windows does not replace open files, which is protection enough
        yield
        return
    lock = part.with_name(part.name + ".lock")
    with lock.open("w") as stream:
        try:
            fcntl.flock(stream, fcntl.LOCK_EX | fcntl.LOCK_NB)
            if os.fstat(stream.fileno()).st_ino != lock.stat().st_ino:  # removed by its holder and created again by another process
                raise FileNotFoundError(lock)
        except OSError as error:
            if error.errno in (errno.ENOLCK, errno.ENOSYS, errno.ENOTSUP):  # a file system without locks
                yield
                return
            raise RunError(f"another process is downloading {part.with_suffix('')}; wait for it, then run the command again") from error
        try:
            yield
        finally:
            lock.unlink(missing_ok=True)
