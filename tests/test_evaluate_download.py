"""Downloads from a server on this machine: resumed, checked, whole or not at all."""

from __future__ import annotations

import hashlib
import threading
from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import pytest
import torch

import test_evaluate_weights as fixtures
from scene_experts.errors import RunError
from scene_experts.evaluate import download, weights

nothing_here = fixtures.nothing_here
CONTENT = bytes(range(256)) * 5000
DIGEST = hashlib.sha256(CONTENT).hexdigest()


class Server(ThreadingHTTPServer):
    """Serves `files`; `cut` ends every answer after so many bytes, `ranges` says whether it can continue one."""

    def __init__(self) -> None:
        super().__init__(("127.0.0.1", 0), Handler)
        self.files: dict[str, bytes] = {"/file": CONTENT}
        self.cut: int | None = None
        self.ranges = True
        self.asked: list[str | None] = []

    @property
    def url(self) -> str:
        return f"http://127.0.0.1:{self.server_port}"


class Handler(BaseHTTPRequestHandler):
    server: Server

    def do_GET(self) -> None:
        wanted = self.headers.get("Range")
        self.server.asked.append(wanted)
        data = self.server.files.get(self.path)
        if data is None:
            self.send_error(404)
            return
        begin = int(wanted.removeprefix("bytes=").rstrip("-")) if wanted and self.server.ranges else 0
        if begin >= len(data):
            self.send_error(416)
            return
        self.send_response(206 if begin else 200)
        self.send_header("Content-Length", str(len(data) - begin))
        self.end_headers()
        body = data[begin:]
        self.wfile.write(body if self.server.cut is None else body[: self.server.cut])

    def log_message(self, *_: object) -> None:
        pass


@pytest.fixture
def server() -> Iterator[Server]:
    with Server() as running:
        thread = threading.Thread(target=running.serve_forever, kwargs={"poll_interval": 0.01}, daemon=True)
        thread.start()
        yield running
        running.shutdown()


def test_fetch(server: Server, tmp_path: Path) -> None:
    path, seen = tmp_path / "deep" / "file", []
    download.fetch(f"{server.url}/file", path, DIGEST, lambda have, total: seen.append((have, total)))
    assert path.read_bytes() == CONTENT and seen[-1] == (len(CONTENT), len(CONTENT))
    assert list(path.parent.iterdir()) == [path]
    download.fetch(f"{server.url}/file", path, DIGEST)
    assert len(server.asked) == 1  # nothing to do the second time


def test_resumes(server: Server, tmp_path: Path) -> None:
    path = tmp_path / "file"
    server.cut = 300_000
    with pytest.raises(RunError, match="run the command again to continue"):
        download.fetch(f"{server.url}/file", path, DIGEST)
    assert not path.exists()
    server.cut = None
    download.fetch(f"{server.url}/file", path, DIGEST)
    assert path.read_bytes() == CONTENT and server.asked == [None, "bytes=300000-"]


def test_server_that_cannot_resume(server: Server, tmp_path: Path) -> None:
    (tmp_path / "file.part").write_bytes(CONTENT[:1000])
    server.ranges = False
    download.fetch(f"{server.url}/file", tmp_path / "file", DIGEST)
    assert (tmp_path / "file").read_bytes() == CONTENT


def test_part_that_is_no_beginning(server: Server, tmp_path: Path) -> None:
    (tmp_path / "file.part").write_bytes(CONTENT + b"more")
    download.fetch(f"{server.url}/file", tmp_path / "file", DIGEST)
    assert (tmp_path / "file").read_bytes() == CONTENT


def test_part_that_is_complete_needs_no_server(tmp_path: Path) -> None:
    (tmp_path / "file.part").write_bytes(CONTENT)
    download.fetch("http://127.0.0.1:1/file", tmp_path / "file", DIGEST)
    assert (tmp_path / "file").read_bytes() == CONTENT


def test_other_content_is_removed(server: Server, tmp_path: Path) -> None:
    with pytest.raises(RunError, match="expected SHA-256 000000000000"):
        download.fetch(f"{server.url}/file", tmp_path / "file", "0" * 64)
    assert list(tmp_path.iterdir()) == []


def test_errors_are_one_sentence(server: Server, tmp_path: Path) -> None:
    with pytest.raises(RunError, match="answered 404"):
        download.fetch(f"{server.url}/gone", tmp_path / "file", DIGEST)
    with pytest.raises(RunError, match="cannot download"):
        download.fetch("http://127.0.0.1:1/file", tmp_path / "file", DIGEST)


def test_lpips(server: Server, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    backbone, linear = fixtures.write_torch(tmp_path / "published")
    fixtures.publish(monkeypatch, weights.BACKBONE, backbone)
    fixtures.publish(monkeypatch, weights.LINEAR, linear)
    server.files = {f"/models/{backbone.name}": backbone.read_bytes(), f"/linear/{linear.name}": linear.read_bytes()}
    download.lpips("alex", backbones=f"{server.url}/models", linears=f"{server.url}/linear")
    tensors, source = weights.load("alex")
    assert source.startswith("cache ") and torch.equal(tensors["lin0"], fixtures.TENSORS["lin0"])
    assert not (weights.cache_dir() / backbone.name).exists()  # only what is needed is kept
