"""Files over HTTP: continued where a download stopped, tried at several addresses, checked, and put in place whole or not at all."""

from __future__ import annotations

import base64
import hashlib
import http.client
import json
import os
import re
import shutil
import ssl
import time
import urllib.error
import urllib.request
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass
from pathlib import Path

from scene_experts.core.errors import InputError, RunError

Progress = Callable[[int, int], None]  # bytes so far, bytes in all (0: unknown)
Say = Callable[[str], None]
TRIES = 4  # attempts at one address that bring nothing new, before the next address
PATIENCE = 1.0  # seconds before the second attempt; doubled each time
SPARE = 64 << 20  # bytes of disk left free


@dataclass(frozen=True)
class Fetched:
    """What was fetched, and from where."""

    url: str
    bytes: int
    sha256: str


@dataclass(frozen=True)
class _Begun:
    """What is known of the file that a part is the beginning of; kept beside it."""

    url: str = ""
    version: str = ""  # the server's ETag or date of change, so that a changed file is not continued
    md5: str = ""  # as the server states it


class _Refused(Exception):
    """This address does not serve the file; trying again would not help."""


def sha256(path: Path) -> str:
    """Hexadecimal SHA-256 of a file."""
    with path.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


def web_address(text: str) -> str:
    """`text` if it is an http or https address; raises InputError otherwise."""
    if not re.match(r"https?://[^/\s]+", text):
        raise InputError(f"expected an address that begins with http:// or https://, found '{text}'; correct it")
    return text


def fetch(
    urls: Sequence[str],
    path: Path,
    digest: str | None = None,
    *,
    size: int | None = None,
    progress: Progress | None = None,
    say: Say | None = None,
    advice: str = "",
) -> Fetched:
    """Download the file that is at any of `urls`, tried in order, to `path`.

    digest: the SHA-256 it must have; without one, what the server itself states (an MD5, the length) is all that can be checked.
    size: its exact bytes, where known.  say: told why an address was given up.  advice: ends the error, what else the user can do.
    What an interrupted download left in `<name>.part` is continued where the server allows it. Content with another checksum is removed.
    Raises RunError when no address serves the right content, or the disk is too small.
    """
    if digest and path.is_file() and sha256(path) == digest:
        return Fetched("", path.stat().st_size, digest)
    part = path.with_name(path.name + ".part")
    reasons: list[str] = []
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with _alone(part):
            if digest and part.is_file() and sha256(part) == digest:
                return _placed(part, path, "", digest)
            for number, url in enumerate(urls, 1):
                try:
                    return _placed(part, path, url, _from(url, part, digest, size, progress))
                except _Refused as error:
                    reasons.append(f"{url}: {error}")
                    if say and number < len(urls):
                        say(f"{reasons[-1]}; trying the next address")
    except OSError as error:
        raise RunError(f"cannot download to {path}: {error.strerror or error}; free some space or choose another folder") from error
    raise RunError(f"cannot download {'; '.join(reasons)}; run the command again to continue it{advice and ', or '}{advice}")


def _placed(part: Path, path: Path, url: str, found: str) -> Fetched:
    part.replace(path)
    _note(part).unlink(missing_ok=True)
    return Fetched(url, path.stat().st_size, found)


def _from(url: str, part: Path, digest: str | None, size: int | None, progress: Progress | None) -> str:
    """Complete `part` from one address and return its SHA-256. Raises _Refused when that fails."""
    tries = 0
    while True:
        before = part.stat().st_size if part.is_file() else 0
        try:
            begun = _continue(url, part, digest is not None, size, progress)
            break
        except urllib.error.HTTPError as error:
            if error.code < 500 and error.code not in (408, 429):
                raise _Refused(f"the server answered {error.code}") from error
            reason = f"the server answered {error.code}"
        except (urllib.error.URLError, http.client.HTTPException, ConnectionError, TimeoutError, ssl.SSLError) as error:
            reason = str(getattr(error, "reason", None) or error or type(error).__name__)
        tries = tries + 1 if not part.is_file() or part.stat().st_size <= before else 1
        if tries >= TRIES:
            raise _Refused(reason)
        time.sleep(PATIENCE * 2 ** (tries - 1))
    try:
        return _checked(part, begun, digest, size)
    except _Refused:
        _forget(part)
        raise


def _checked(part: Path, begun: _Begun, digest: str | None, size: int | None) -> str:
    """The SHA-256 of a complete download whose length and checksums are as they should be."""
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


def _continue(url: str, part: Path, known: bool, size: int | None, progress: Progress | None) -> _Begun:
    """Append what is missing of `url` to `part`, or start over where the server sends the whole file.

    known: the checksum is, so a part from another address may be continued too; a wrong one is found out at the end.
    """
    have, begun = _resumable(url, part, known)
    headers = {"User-Agent": "scene-experts", "Accept-Encoding": "identity"}
    if have:
        headers["Range"] = f"bytes={have}-"
        if begun.url == url and begun.version:
            headers["If-Range"] = begun.version
    try:
        answer = urllib.request.urlopen(urllib.request.Request(web_address(url), headers=headers), timeout=60)
    except urllib.error.HTTPError as error:
        if error.code != 416 or not have:  # 416: there is nothing after what we have
            raise
        if error.headers.get("Content-Range") == f"bytes */{have}" or have == size:
            return begun  # it was whole
        _forget(part)
        return _continue(url, part, known, size, progress)
    with answer:
        resumed = answer.status == 206 and (answer.headers.get("Content-Range") or f"bytes {have}-").startswith(f"bytes {have}-")
        if answer.status == 206 and not resumed:
            raise _Refused("the server sent another range than was asked for")
        have = have if resumed else 0
        total = have + int(answer.headers.get("Content-Length") or 0)
        _expect_file(answer.headers.get("Content-Type") or "", total if total > have else 0, size)
        _expect_room(part, total - have)
        if not resumed:
            begun = _Begun(url, _version(answer.headers), _stated_md5(answer.headers))
            _note(part).write_text(json.dumps(asdict(begun)))
        have = _append(answer, part, have, total if total > have else 0, progress)
    if have < total:
        raise ConnectionError(f"the connection ended after {have} of {total} bytes")
    return begun


def _append(answer: http.client.HTTPResponse, part: Path, have: int, total: int, progress: Progress | None) -> int:
    with part.open("ab" if have else "wb") as stream:
        while block := answer.read(1 << 20):
            stream.write(block)
            have += len(block)
            if progress:
                progress(have, total)
    return have


def _resumable(url: str, part: Path, known: bool) -> tuple[int, _Begun]:
    """Bytes of `part` that `url` may continue, and what is known of their file; (0, ...) to begin anew."""
    have = part.stat().st_size if part.is_file() else 0
    begun = _Begun()
    with suppress(OSError, ValueError, TypeError):
        begun = _Begun(**json.loads(_note(part).read_text()))
    same = begun.url == url and begun.version != ""
    return (have, begun) if have and (known or same) else (0, begun)


def _expect_file(kind: str, total: int, size: int | None) -> None:
    """Raises _Refused for an answer that cannot be the file: a web page (moved, a quota used up), another length."""
    if kind.partition(";")[0].strip().lower() in ("text/html", "application/xhtml+xml"):
        raise _Refused("the server sent a web page instead of the file (it moved, or its quota of downloads is used up)")
    if size is not None and total and total != size:
        raise _Refused(f"expected {size:,} bytes, found {total:,}")


def _expect_room(part: Path, missing: int) -> None:
    """Raises RunError where the disk cannot take `missing` more bytes."""
    free = shutil.disk_usage(part.parent).free
    if missing + SPARE > free:
        raise RunError(
            f"expected {(missing + SPARE) / 1e9:.1f} GB free at {part.parent} for the download, found {free / 1e9:.1f} GB; "
            f"free some space or choose another folder"
        )


def _version(headers: http.client.HTTPMessage) -> str:
    """A strong ETag, else the date of the last change, else nothing."""
    tag = headers.get("ETag") or ""
    return tag if tag.startswith('"') else headers.get("Last-Modified") or ""


def _stated_md5(headers: http.client.HTTPMessage) -> str:
    """The MD5 of the whole file that a server states (Google Cloud Storage: x-goog-hash), in hexadecimal, or nothing."""
    for value in headers.get_all("x-goog-hash") or []:
        if found := re.search(r"md5=([A-Za-z0-9+/]{22}==)", value):
            return base64.b64decode(found[1]).hex()
    return ""


def _note(part: Path) -> Path:
    return part.with_name(part.name + ".json")


def _forget(part: Path) -> None:
    part.unlink(missing_ok=True)
    _note(part).unlink(missing_ok=True)


@contextmanager
def _alone(part: Path) -> Iterator[None]:
    """Raises RunError while another process of this machine fetches the same file: two would interleave their blocks."""
    try:
        import fcntl
    except ImportError:  # Windows: an open file cannot be replaced there, which is guard enough
        yield
        return
    lock = part.with_name(part.name + ".lock")
    with lock.open("w") as stream:
        try:
            fcntl.flock(stream, fcntl.LOCK_EX | fcntl.LOCK_NB)
            if os.fstat(stream.fileno()).st_ino != lock.stat().st_ino:  # the holder has just removed it, and another made it anew
                raise FileNotFoundError(lock)
        except OSError as error:
            raise RunError(f"another process is fetching {part.with_suffix('')} now; wait for it, then run the command again") from error
        try:
            yield
        finally:
            lock.unlink(missing_ok=True)
