"""Scenes from a server on this machine: shared archives, recorded checksums, and advice for what is done by hand."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import pytest

from scene_experts.core.errors import InputError, RunError
from scene_experts.data.fetch import download, obtain
from scene_experts.data.fetch.catalog import CatalogScene, Collection, RemoteArchive
from support.archives import in_folder, read_tree, write_zip
from support.messages import naming
from support.web import Server, serving

FILES = {"images/a.jpg": b"a", "images/b.jpg": b"b", "sparse/0/cameras.bin": b"c"}


@pytest.fixture
def server(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Iterator[Server]:
    monkeypatch.setattr(download, "PATIENCE", 0.0)
    source = write_zip(tmp_path / "both.zip", {**in_folder("both/truck", FILES), **in_folder("both/train", FILES)})
    with serving() as running:
        running.files["/both.zip"] = source.read_bytes()
        source.unlink()
        yield running


def scenes(server: Server, **facts: object) -> list[CatalogScene]:
    archive = replace(RemoteArchive("both.zip", (f"{server.url}/both.zip",), "https://owner/page", "1 kB"), **facts)  # type: ignore[arg-type]
    collection = Collection("pair", "Pair", archive, "not stated", "Somebody, 2020")
    return [CatalogScene(name, collection, (f"both/{name}",), "as-is", views=2) for name in ("truck", "train")]


def get(wanted: list[CatalogScene], root: Path, **options: object) -> list[str]:
    said: list[str] = []
    obtain.obtain(wanted, root, say=said.append, **options)  # type: ignore[arg-type]
    return said


def test_an_archive_is_fetched_once(server: Server, tmp_path: Path) -> None:
    both, seen = scenes(server), []
    said = get(both[:1], tmp_path, progress=lambda *told: seen.append(told))
    folder = tmp_path / "pair" / "truck"
    source = json.loads((folder / "source.json").read_text())
    digest = hashlib.sha256(server.files["/both.zip"]).hexdigest()
    assert source["archive_sha256"] == digest and source["licence"] == "not stated" and source["inside"] == "both/truck"
    assert read_tree(folder).keys() == {*FILES, "source.json"} and not (tmp_path / "pair" / "train").exists()
    assert {told[0] for told in seen} == {"both.zip", "unpacking truck"}
    assert any(digest in line for line in said)
    assert str(folder) in get(both, tmp_path)[0] and server.asked == [None]
    assert all(obtain.is_present(tmp_path, s) for s in both)
    assert get(both, tmp_path) == [f"{s.name} is at {tmp_path / s.path}" for s in both]


def test_archives_are_removed_on_request(server: Server, tmp_path: Path) -> None:
    get(scenes(server), tmp_path, keep=False)
    assert [p.name for p in (tmp_path / "archives").iterdir()] == ["checksums.json"]


def test_later_downloads_are_compared_with_the_first(server: Server, tmp_path: Path) -> None:
    both = scenes(server)
    get(both[:1], tmp_path, keep=False)
    server.files["/both.zip"] += b"changed"
    with pytest.raises(RunError, match=naming("SHA-256", "both.zip", "1 kB", "https://owner/page")):
        get(both, tmp_path)
    (tmp_path / "archives" / "checksums.json").unlink()
    server.files["/both.zip"] = server.files["/both.zip"].removesuffix(b"changed")
    get(both, tmp_path)
    (tmp_path / "archives" / "both.zip").write_bytes(b"damaged since")
    (tmp_path / "pair" / "train").rename(tmp_path / "away")
    with pytest.raises(RunError, match=naming("SHA-256", "both.zip")):
        get(both, tmp_path)


def test_published_facts_are_checked(server: Server, tmp_path: Path) -> None:
    data = server.files["/both.zip"]
    get(scenes(server, sha256=hashlib.sha256(data).hexdigest(), bytes=len(data)), tmp_path / "right")
    with pytest.raises(RunError, match=naming("SHA-256", "000000000000")):
        get(scenes(server, sha256="0" * 64), tmp_path / "wrong")
    with pytest.raises(RunError, match=naming(5, 804)):
        get(scenes(server, bytes=5), tmp_path / "wrong")
    assert not (tmp_path / "wrong" / "pair").exists()


def test_mirrors_come_first_and_the_owner_last(server: Server, tmp_path: Path) -> None:
    server.files["/copies/both.zip"] = server.files["/both.zip"]
    get(scenes(server), tmp_path / "a", mirrors=[f"{server.url}/copies/"])
    get(scenes(server), tmp_path / "b", mirrors=[f"{server.url}/gone", f"{server.url}/both.zip"])
    assert server.paths == ["/copies/both.zip", "/gone/both.zip", "/both.zip"]
    with pytest.raises(InputError, match="http://"):
        get(scenes(server), tmp_path / "c", mirrors=["/some/folder"])


def test_without_a_source_the_error_says_where_to_put_the_archive(server: Server, tmp_path: Path) -> None:
    data = server.files.pop("/both.zip")
    place = tmp_path / "archives" / "both.zip"
    with pytest.raises(RunError, match=naming(404, "https://owner/page", place)):
        get(scenes(server), tmp_path)
    place.write_bytes(data)
    assert f"using {place}" in get(scenes(server)[:1], tmp_path)
    assert json.loads((tmp_path / "archives" / "checksums.json").read_text())["both.zip"]["bytes"] == len(data)


def test_a_damaged_download_is_not_recorded(server: Server, tmp_path: Path) -> None:
    whole = server.files["/both.zip"]
    server.files["/both.zip"] = whole[:-30]
    with pytest.raises(RunError, match=naming("both.zip")):
        get(scenes(server), tmp_path)
    assert not (tmp_path / "archives" / "checksums.json").exists()
    (tmp_path / "archives" / "both.zip").unlink()
    server.files["/both.zip"] = whole
    get(scenes(server), tmp_path)


def test_a_scene_that_was_copied_by_hand_is_used(server: Server, tmp_path: Path) -> None:
    truck = scenes(server)[0]
    (tmp_path / "pair" / "truck" / "images").mkdir(parents=True)
    with pytest.raises(RunError, match=naming(tmp_path / "pair" / "truck")):
        get([truck], tmp_path)
    (tmp_path / "pair" / "truck" / "sparse").mkdir()
    assert get([truck], tmp_path) == [f"truck is at {tmp_path / 'pair' / 'truck'}"]


def test_another_number_of_photographs_is_a_warning(server: Server, tmp_path: Path) -> None:
    said = get([replace(scenes(server)[0], views=3)], tmp_path)
    assert any(all(fact in line for fact in ("warning", "truck", "3", "2")) for line in said)


def test_names_resolve_to_folders_and_the_papers_protocol(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(obtain.VARIABLE, str(tmp_path))
    assert obtain.captures_dir() == tmp_path
    assert obtain.resolve(Path("some/folder"), "auto", "auto") == (Path("some/folder"), "auto", "auto")
    with pytest.raises(InputError, match=r"mipnerf360/bonsai.*download bonsai"):
        obtain.resolve(Path("catalog:bonsai"), "auto", "auto")
    for name in ("images", "sparse"):
        (tmp_path / "mipnerf360" / "bonsai" / name).mkdir(parents=True)
    folder = tmp_path / "mipnerf360" / "bonsai"
    assert obtain.resolve(Path("catalog:bonsai"), "auto", "auto") == (folder, "inria:2", "mod8")
    assert obtain.resolve(Path("catalog:mipnerf360/bonsai"), "cap1600", "none") == (folder, "cap1600", "none")
    with pytest.raises(InputError, match="'bonsai'"):
        obtain.resolve(Path("catalog:bonsay"), "auto", "auto")


def test_a_damaged_record_of_checksums(server: Server, tmp_path: Path) -> None:
    (tmp_path / "archives").mkdir()
    (tmp_path / "archives" / "checksums.json").write_text('{"both.zip": 3}')
    with pytest.raises(InputError, match=naming("checksums.json")):
        get(scenes(server), tmp_path)
