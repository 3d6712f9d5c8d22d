"""A server that answers as it likes: every answer ends in the file or in one sentence, within the limits of bytes and time."""

from __future__ import annotations

import random
import socket
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from scene_experts.core.errors import RunError
from scene_experts.data.fetch import download
from support.messages import naming

BODY = bytes(range(256)) * 4  # 1,024 bytes
GOOD = b"HTTP/1.1 200 OK\r\nContent-Length: 1024\r\nContent-Type: application/zip\r\n\r\n" + BODY


class Scripted:
    """Answers every connection with `answer`: bytes, or a function that writes to the socket."""

    def __init__(self) -> None:
        self.answer: object = GOOD
        self.sent = 0
        self.listener = socket.create_server(("127.0.0.1", 0), backlog=64)
        self.url = f"http://127.0.0.1:{self.listener.getsockname()[1]}/file"
        threading.Thread(target=self.serve, daemon=True).start()

    def serve(self) -> None:
        while True:
            try:
                connection, _ = self.listener.accept()
            except OSError:
                return
            threading.Thread(target=self.reply, args=(connection,), daemon=True).start()

    def reply(self, connection: socket.socket) -> None:
        with connection:
            try:
                connection.settimeout(10)
                connection.recv(65536)
                if callable(self.answer):
                    self.answer(connection)
                else:
                    connection.sendall(self.answer)  # type: ignore[arg-type]
            except OSError:
                pass


@pytest.fixture
def server(monkeypatch: pytest.MonkeyPatch) -> Iterator[Scripted]:
    monkeypatch.setattr(download, "PATIENCE", 0.0)
    for name in ("http_proxy", "https_proxy", "all_proxy"):
        monkeypatch.delenv(name, raising=False)
        monkeypatch.delenv(name.upper(), raising=False)
    made = Scripted()
    yield made
    made.listener.close()


def head(*lines: str, status: str = "200 OK", body: bytes = b"") -> bytes:
    return "\r\n".join([f"HTTP/1.1 {status}", *lines, "", ""]).encode("latin-1") + body


NASTY = [
    head("Content-Length: abc", body=b"x" * 100),
    head("Content-Length: -5", body=b"x" * 100),
    head("Content-Length: " + "9" * 5000, body=b"x"),
    head("Content-Length: 1e3", body=BODY),
    head("Content-Length: 10", "Content-Length: 20", body=BODY),
    head("Location: http://[", status="302 Found"),
    head("Location: http://" + "a" * 70 + ".example/", status="302 Found"),
    head("Location: http://a..b/", status="302 Found"),
    head("Location: file:///etc/passwd", status="302 Found"),
    head("Location: ftp://127.0.0.1/x", status="302 Found"),
    head("Location: http://127.0.0.1:99999/", status="302 Found"),
    head("Location: http://127.0.0.1:abc/", status="301 Moved"),
    head("Location: \xff\xfe", status="307 Moved"),
    head(status="302 Found"),
    head("Location: /file", status="302 Found"),
    head(status="204 No Content"),
    head(status="205 Reset Content"),
    head(status="304 Not Modified"),
    head(status="206 Partial Content", body=b"x" * 10),
    head("Content-Range: bytes 5-9/1024", status="206 Partial Content", body=b"x" * 5),
    head("Content-Range: nonsense", status="416 Range Not Satisfiable"),
    head("Transfer-Encoding: chunked", body=b"-5\r\nxxxxx\r\n0\r\n\r\n"),
    head("Transfer-Encoding: chunked", body=b"zz\r\nxxxxx\r\n0\r\n\r\n"),
    head("Transfer-Encoding: chunked", body=b"f" * 5000 + b"\r\nx"),
    head("Transfer-Encoding: chunked", body=b"5\r\nxx"),
    head("Transfer-Encoding: chunked", body=b"7fffffffffffffff\r\nxx"),
    head("Content-Encoding: gzip", "Content-Length: 4", body=b"abcd"),
    head("Content-Type: text/html", body=b"<html>"),
    head("Content-Type: " + "a/" * 3000, body=b"x"),
    head(*[f"X-{i}: {i}" for i in range(500)], body=BODY),
    head("X: " + "y" * 100_000, body=BODY),
    head("ETag: " + '"' + "\xe9" * 100 + '"', body=b"x"),
    head("x-goog-hash: md5=AAAAAAAAAAAAAAAAAAAAAA==", body=b"x"),
    head(status="999 Strange"),
    head(status="-1 Strange"),
    head(status="abc"),
    b"HTTP/9.9 200 OK\r\n\r\n",
    b"HTTP/1.1\r\n\r\n",
    b"\r\n\r\n",
    b"\0" * 1000,
    b"SSH-2.0-x\r\n",
    b"",
    b"HTTP/1.1 100 Continue\r\n\r\n" * 50,
    GOOD[:-1],
    GOOD[:40],
    GOOD,
]


def mutated(rng: random.Random) -> bytes:
    """A nasty answer with some bytes changed, removed, doubled or swapped for parts of another."""
    data = bytearray(rng.choice(NASTY)[:4000])
    for _ in range(rng.randrange(5)):
        at = rng.randrange(len(data) + 1)
        kind = rng.randrange(4)
        if kind == 0:
            data[at : at + 1] = bytes([rng.randrange(256)])
        elif kind == 1:
            del data[at : at + rng.randrange(1, 30)]
        elif kind == 2:
            data[at:at] = data[max(0, at - 20) : at] * rng.randrange(1, 4)
        else:
            other = rng.choice(NASTY)
            begin = rng.randrange(len(other) + 1)
            data[at:at] = other[begin : begin + 60]
    return bytes(data)


@pytest.mark.slow
def test_a_thousand_answers_end_in_the_file_or_in_one_sentence(server: Scripted, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(download, "ANSWER", 2.0)
    rng, fine, failed = random.Random(1), 0, 0
    answers = NASTY + [mutated(rng) for _ in range(1000 - len(NASTY))]
    for number, answer in enumerate(answers):
        server.answer = answer
        path = tmp_path / str(number) / "file"
        began = time.monotonic()
        try:
            got = download.fetch([server.url], path, size=rng.choice([None, 1024]))
            assert path.is_file() and path.stat().st_size == got.bytes
            fine += 1
        except RunError as error:
            assert "cannot download" in str(error) and str(error).isprintable() and len(str(error)) < 2000
            failed += 1
        assert time.monotonic() - began < 15
        assert not path.is_file() or path.stat().st_size <= 1 << 20
    assert fine + failed == 1000 and fine > 10 and failed > 500


@pytest.mark.parametrize("status", ["204 No Content", "202 Accepted", "203 Other"])
def test_only_200_and_206_are_a_file(status: str, server: Scripted, tmp_path: Path) -> None:
    server.answer = head("Content-Length: 1024", status=status, body=BODY)
    with pytest.raises(RunError, match=naming(status[:3])):
        download.fetch([server.url], tmp_path / "file")
    assert not (tmp_path / "file").exists()


def test_no_more_bytes_than_the_file_has(server: Scripted, tmp_path: Path) -> None:
    def endless(connection: socket.socket) -> None:
        connection.sendall(b"HTTP/1.1 200 OK\r\n\r\n")
        while True:
            connection.sendall(b"x" * 65536)
            server.sent += 65536

    server.answer = endless
    with pytest.raises(RunError, match=naming("1,000")):
        download.fetch([server.url], tmp_path / "file", size=1000)
    assert server.sent < 16 << 20 and list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("where", ["head", "body", "head, when the time was over before the connection"])
def test_a_server_that_drips_is_left(where: str, server: Scripted, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(download, "ANSWER", 0.5)
    monkeypatch.setattr(download, "WINDOW", 0.5)
    real = socket.create_connection
    if "over" in where:
        monkeypatch.setattr(socket, "create_connection", lambda *options: time.sleep(1) or real(*options))

    def drip(connection: socket.socket) -> None:
        connection.sendall(b"HTTP/1.1 200 OK\r\n" + (b"\r\n" if where == "body" else b""))
        while True:
            connection.sendall(b"x")
            time.sleep(0.05)

    server.answer = drip
    began = time.monotonic()
    with pytest.raises(RunError, match="cannot download"):
        download.fetch([server.url], tmp_path / "file", size=1000)
    assert time.monotonic() - began < 60
