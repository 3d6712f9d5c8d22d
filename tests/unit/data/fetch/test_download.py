"""Downloads from a server on this machine: resuming, verification, several addresses, atomic results."""

from __future__ import annotations

import base64
import hashlib
from collections.abc import Iterator
from pathlib import Path

import pytest

from scene_experts.core.errors import InputError, RunError
from scene_experts.data.fetch import download
from support.messages import naming
from support.web import Server, serving

CONTENT = bytes(range(256)) * 5000
DIGEST = hashlib.sha256(CONTENT).hexdigest()
DEAD = "http://127.0.0.1:1/file"


@pytest.fixture
def server(monkeypatch: pytest.MonkeyPatch) -> Iterator[Server]:
    monkeypatch.setattr(download, "PATIENCE", 0.0)
    with serving() as running:
        running.files["/file"] = CONTENT
        yield running


def test_fetch(server: Server, tmp_path: Path) -> None:
    path, seen = tmp_path / "deep" / "file", []
    got = download.fetch([f"{server.url}/file"], path, DIGEST, progress=lambda have, total: seen.append((have, total)))
    assert path.read_bytes() == CONTENT and seen[-1] == (len(CONTENT), len(CONTENT))
    assert got == download.Fetched(f"{server.url}/file", len(CONTENT), DIGEST)
    assert list(path.parent.iterdir()) == [path]
    download.fetch([f"{server.url}/file"], path, DIGEST)
    assert len(server.asked) == 1  # the second call has nothing to do


def test_an_incomplete_answer_is_resumed(server: Server, tmp_path: Path) -> None:
    server.cuts = [300_000, 200_000]
    download.fetch([f"{server.url}/file"], tmp_path / "file", DIGEST)
    assert (tmp_path / "file").read_bytes() == CONTENT and server.asked == [None, "bytes=300000-", "bytes=500000-"]


def test_the_next_call_resumes_the_download(server: Server, tmp_path: Path) -> None:
    server.cuts = [300_000] + [0] * 10
    with pytest.raises(RunError, match=naming(300000, 1280000)):
        download.fetch([f"{server.url}/file"], tmp_path / "file", DIGEST)
    assert not (tmp_path / "file").exists()
    server.cuts, server.asked = [], []
    download.fetch([f"{server.url}/file"], tmp_path / "file", DIGEST)
    assert (tmp_path / "file").read_bytes() == CONTENT and server.asked == ["bytes=300000-"]


def test_server_that_cannot_resume(server: Server, tmp_path: Path) -> None:
    (tmp_path / "file.part").write_bytes(CONTENT[:1000])
    server.ranges = False
    download.fetch([f"{server.url}/file"], tmp_path / "file", DIGEST)
    assert (tmp_path / "file").read_bytes() == CONTENT


def test_a_part_that_is_not_the_beginning_of_the_file(server: Server, tmp_path: Path) -> None:
    (tmp_path / "file.part").write_bytes(CONTENT + b"more")
    download.fetch([f"{server.url}/file"], tmp_path / "file", DIGEST)
    assert (tmp_path / "file").read_bytes() == CONTENT


def test_a_complete_part_needs_no_server(tmp_path: Path) -> None:
    (tmp_path / "file.part").write_bytes(CONTENT)
    download.fetch([DEAD], tmp_path / "file", DIGEST)
    assert (tmp_path / "file").read_bytes() == CONTENT


def test_without_a_checksum_only_the_same_version_is_resumed(server: Server, tmp_path: Path) -> None:
    server.headers["/file"] = {"ETag": '"one"'}
    server.cuts = [300_000] + [0] * 10
    with pytest.raises(RunError, match=naming(300000, 1280000)):
        download.fetch([f"{server.url}/file"], tmp_path / "file")
    server.cuts, server.asked = [], []
    download.fetch([f"{server.url}/file"], tmp_path / "same")  # another name has a part of its own
    (tmp_path / "other.part").write_bytes((tmp_path / "file.part").read_bytes())
    (tmp_path / "other.part.json").write_text((tmp_path / "file.part.json").read_text())
    got = download.fetch([f"{server.url}/file"], tmp_path / "file")
    assert got.sha256 == DIGEST and server.asked == [None, "bytes=300000-"]
    server.files["/file"], server.headers["/file"] = CONTENT[::-1], {"ETag": '"two"'}
    download.fetch([f"{server.url}/file"], tmp_path / "other")
    assert (tmp_path / "other").read_bytes() == CONTENT[::-1]


def test_without_a_checksum_or_version_a_download_starts_over(server: Server, tmp_path: Path) -> None:
    (tmp_path / "file.part").write_bytes(b"x" * 1000)
    download.fetch([f"{server.url}/file"], tmp_path / "file")
    assert (tmp_path / "file").read_bytes() == CONTENT and server.asked == [None]


def test_the_md5_that_a_server_states_is_checked(server: Server, tmp_path: Path) -> None:
    stated = base64.b64encode(hashlib.md5(CONTENT).digest()).decode()
    server.headers["/file"] = {"x-goog-hash": f"crc32c=AAAAAA==,md5={stated}"}
    download.fetch([f"{server.url}/file"], tmp_path / "file")
    server.files["/file"] = CONTENT[::-1]
    with pytest.raises(RunError, match="MD5"):
        download.fetch([f"{server.url}/file"], tmp_path / "again")
    assert not (tmp_path / "again.part").exists()


def test_other_content_is_removed(server: Server, tmp_path: Path) -> None:
    with pytest.raises(RunError, match=naming("SHA-256", "000000000000")):
        download.fetch([f"{server.url}/file"], tmp_path / "file", "0" * 64)
    assert list(tmp_path.iterdir()) == []


def test_addresses_are_tried_in_order(server: Server, tmp_path: Path) -> None:
    server.files |= {"/wrong": CONTENT[::-1], "/short": CONTENT[:1000], "/page": b"<html>quota</html>"}
    server.headers["/page"] = {"Content-Type": "text/html; charset=utf-8"}
    said: list[str] = []
    urls = [DEAD, *(f"{server.url}/{name}" for name in ("gone", "page", "short", "wrong", "file"))]
    got = download.fetch(urls, tmp_path / "file", DIGEST, size=len(CONTENT), say=said.append)
    assert got.url == urls[-1] and (tmp_path / "file").read_bytes() == CONTENT
    assert [text.partition(": ")[0] for text in said] == urls[:-1]
    for text, why in zip(said, ("", "404", "", "1,280,000", "SHA-256"), strict=True):
        assert why in text


def test_a_busy_server_is_asked_again(server: Server, tmp_path: Path) -> None:
    server.codes = [503, 429]
    download.fetch([f"{server.url}/file"], tmp_path / "file", DIGEST)
    assert len(server.asked) == 3


def test_redirects_are_followed(server: Server, tmp_path: Path) -> None:
    server.redirects["/old"] = f"{server.url}/file"
    download.fetch([f"{server.url}/old"], tmp_path / "file", DIGEST)
    server.redirects["/local"] = f"file://{tmp_path}/file"
    with pytest.raises(RunError, match=naming("http://127.0.0.1")):
        download.fetch([f"{server.url}/local"], tmp_path / "copy")


def test_errors_are_one_sentence(server: Server, tmp_path: Path) -> None:
    with pytest.raises(RunError, match=naming(404, "call them")) as caught:
        download.fetch([f"{server.url}/gone"], tmp_path / "file", DIGEST, advice="call them")
    assert "\n" not in str(caught.value)
    with pytest.raises(RunError, match=naming("http://127.0.0.1")):
        download.fetch([DEAD], tmp_path / "file", DIGEST)
    with pytest.raises(InputError, match="http://"):
        download.check_web_address("ftp://host/file")


def test_a_full_disk_is_reported_before_anything_is_written(server: Server, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(download.shutil, "disk_usage", lambda _: type("Usage", (), {"free": 1000})())
    with pytest.raises(RunError, match=naming("0.1 GB")):
        download.fetch([f"{server.url}/file"], tmp_path / "file", DIGEST)
    assert list(tmp_path.iterdir()) == []


def test_one_process_at_a_time(server: Server, tmp_path: Path) -> None:
    with download._lock(tmp_path / "file.part"), pytest.raises(RunError, match=naming(tmp_path / "file")):
        download.fetch([f"{server.url}/file"], tmp_path / "file", DIGEST)
