"""A local web server for tests of downloads: range requests, truncated answers, redirects, web pages."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer


class Server(ThreadingHTTPServer):
    """Serves `files`. Each number in `cuts` ends one answer after that many bytes. ranges: whether it supports range requests."""

    def __init__(self) -> None:
        super().__init__(("127.0.0.1", 0), Handler)
        self.files: dict[str, bytes] = {}
        self.headers: dict[str, dict[str, str]] = {}  # further headers, by path
        self.redirects: dict[str, str] = {}
        self.cuts: list[int] = []
        self.codes: list[int] = []  # answers of the next requests instead of files
        self.ranges = True
        self.asked: list[str | None] = []
        self.paths: list[str] = []

    @property
    def url(self) -> str:
        return f"http://127.0.0.1:{self.server_port}"


class Handler(BaseHTTPRequestHandler):
    server: Server

    def do_GET(self) -> None:
        server, wanted = self.server, self.headers.get("Range")
        server.asked.append(wanted)
        server.paths.append(self.path)
        if self.path in server.redirects:
            self.send_response(302)
            self.send_header("Location", server.redirects[self.path])
            self.end_headers()
            return
        data, extra = server.files.get(self.path), server.headers.get(self.path, {})
        if data is None or server.codes:
            self.send_error(server.codes.pop(0) if server.codes else 404)
            return
        condition = self.headers.get("If-Range")
        fits = server.ranges and (condition is None or condition == extra.get("ETag"))
        begin = int(wanted.removeprefix("bytes=").rstrip("-")) if wanted and fits else 0
        if begin >= len(data):
            self.send_response(416)
            self.send_header("Content-Range", f"bytes */{len(data)}")
            self.send_header("Content-Length", "0")
            self.end_headers()
            return
        self.send_response(206 if begin else 200)
        self.send_header("Content-Length", str(len(data) - begin))
        if begin:
            self.send_header("Content-Range", f"bytes {begin}-{len(data) - 1}/{len(data)}")
        for name, value in extra.items():
            self.send_header(name, value)
        self.end_headers()
        body = data[begin:]
        self.wfile.write(body[: server.cuts.pop(0)] if server.cuts else body)

    def log_message(self, *_: object) -> None:
        pass


@contextmanager
def serving() -> Iterator[Server]:
    """A running server, gone afterwards."""
    with Server() as running:
        thread = threading.Thread(target=running.serve_forever, kwargs={"poll_interval": 0.01}, daemon=True)
        thread.start()
        try:
            yield running
        finally:
            running.shutdown()
            thread.join()
