"""Scenes from archives: only their own plain files, within size limits, all of them or none."""

from __future__ import annotations

import gzip
import io
import lzma
import os
import random
import stat
import zipfile
from pathlib import Path

import pytest

from scene_experts.core.errors import RunError
from scene_experts.data.fetch import archive
from support.archives import FILES, in_folder, read_tree, write_tar, write_zip
from support.messages import naming


@pytest.mark.parametrize("write", [write_zip, write_tar])
@pytest.mark.parametrize("prefix", ["tandt/truck", "truck", "./some/where/truck", "Truck"])
def test_one_scene_of_many(tmp_path: Path, write, prefix: str) -> None:
    source = write(
        tmp_path / "a",
        {**in_folder("tandt/train"), **in_folder(prefix), "truck.txt": b"x", f"{prefix}/.DS_Store": b"", f"{prefix}/images/._a.jpg": b""},
    )
    seen: list[tuple[int, int]] = []
    out = archive.extract(source, "truck", tmp_path / "deep" / "truck", ["tandt/truck"], lambda *n: seen.append(n))
    assert read_tree(tmp_path / "deep" / "truck") == FILES and seen[-1] == (1011, 1011)
    assert out == archive.Extracted(prefix.removeprefix("./"), 4, 1011)
    assert os.listdir(tmp_path / "deep") == ["truck"]
    assert stat.S_IMODE((tmp_path / "deep" / "truck").stat().st_mode) == stat.S_IMODE((tmp_path / "deep").stat().st_mode)


def test_the_stated_place_takes_precedence_and_two_others_are_rejected(tmp_path: Path) -> None:
    source = write_zip(tmp_path / "a.zip", {**in_folder("x/truck", {"images/x": b"x"}), **in_folder("y/truck", {"images/y": b"y"})})
    archive.extract(source, "truck", tmp_path / "one", ["y/truck"])
    assert read_tree(tmp_path / "one") == {"images/y": b"y"}
    with pytest.raises(RunError, match=naming("a.zip", 2)):
        archive.extract(source, "truck", tmp_path / "two", ["z/truck"])
    with pytest.raises(RunError, match=naming("train", "a.zip", "truck")):
        archive.extract(source, "train", tmp_path / "two")


@pytest.mark.parametrize("name", ["../evil", "images/../../evil", "images/..\\..\\evil", "C:evil", "images/./x"])
def test_names_that_lead_outside_the_folder_are_rejected(tmp_path: Path, name: str) -> None:
    source = write_zip(tmp_path / "a.zip", {**in_folder("truck"), f"truck/{name}": b"evil"})
    with pytest.raises(RunError, match=naming("a.zip")):
        archive.extract(source, "truck", tmp_path / "in" / "truck")
    assert not list(tmp_path.rglob("*evil*")) and not (tmp_path / "in").exists()


def test_links_are_rejected(tmp_path: Path) -> None:
    tar = write_tar(tmp_path / "a.tar.gz", in_folder("truck"), {"truck/images/link.jpg": "/etc/passwd"})
    with pytest.raises(RunError, match=naming("link.jpg")):
        archive.extract(tar, "truck", tmp_path / "truck")
    link = zipfile.ZipInfo("truck/images/link.jpg")
    link.external_attr = (stat.S_IFLNK | 0o777) << 16
    zipped = write_zip(tmp_path / "a.zip", in_folder("truck"))
    with zipfile.ZipFile(zipped, "a") as out:
        out.writestr(link, "/etc/passwd")
    with pytest.raises(RunError, match=naming("link.jpg")):
        archive.extract(zipped, "truck", tmp_path / "truck")
    archive.extract(write_tar(tmp_path / "b", in_folder("truck"), {"train/link": "/etc"}), "truck", tmp_path / "truck")  # not in the scene


def test_bounds(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    source = write_zip(tmp_path / "a.zip", in_folder("truck"))
    with monkeypatch.context() as patch:
        patch.setattr(archive, "MOST_BYTES", 1010)
        with pytest.raises(RunError, match=naming(4, "0 GB")):
            archive.extract(source, "truck", tmp_path / "truck")
    with monkeypatch.context() as patch:
        patch.setattr(archive, "MOST_FILES", 3)
        with pytest.raises(RunError, match=naming(4, 3)):
            archive.extract(source, "truck", tmp_path / "truck")
    monkeypatch.setattr(archive.shutil, "disk_usage", lambda _: type("Usage", (), {"free": 1000})())
    with pytest.raises(RunError, match=naming("truck", "0.0 GB")):
        archive.extract(source, "truck", tmp_path / "truck")
    assert [p.name for p in tmp_path.iterdir()] == ["a.zip"]


def test_two_files_with_the_same_name_are_rejected(tmp_path: Path) -> None:
    source = write_zip(tmp_path / "a.zip", in_folder("truck"))
    with zipfile.ZipFile(source, "a") as out, pytest.warns(UserWarning, match="Duplicate"):
        out.writestr("truck/poses.npy", b"other")
    with pytest.raises(RunError, match=naming("truck/poses.npy")):
        archive.extract(source, "truck", tmp_path / "truck")


def damaged_bytes(path: Path) -> Path:
    data = bytearray(path.read_bytes())
    at = data.index(b"b" * 500)
    data[at] ^= 1
    path.write_bytes(bytes(data))
    return path


def test_damage_leaves_nothing(tmp_path: Path) -> None:
    (tmp_path / "text.zip").write_text("<html>")
    cut = write_zip(tmp_path / "cut.zip", in_folder("truck"))
    cut.write_bytes(cut.read_bytes()[:-30])
    short = write_tar(tmp_path / "short.tar.gz", {**in_folder("truck"), "truck/images/noise": os.urandom(50_000)})
    short.write_bytes(short.read_bytes()[:-20_000])
    flipped = damaged_bytes(write_zip(tmp_path / "flipped.zip", in_folder("truck"), zipfile.ZIP_STORED))
    for source in (tmp_path / "text.zip", cut, short, flipped):
        with pytest.raises(RunError, match=naming(source)):
            archive.extract(source, "truck", tmp_path / "out" / "truck")
    assert not (tmp_path / "out").exists() or not list((tmp_path / "out").iterdir())


def test_an_entry_longer_than_declared_is_rejected() -> None:
    member = archive.Member("x", 4, "file", lambda: io.BytesIO(b"12345"))
    with pytest.raises(EOFError, match="x"):
        archive._copy(member.open(), io.BytesIO(), member, 0, 4, None)
    with pytest.raises(EOFError, match="x"):
        archive._copy(io.BytesIO(b"123"), io.BytesIO(), member, 0, 4, None)


@pytest.mark.parametrize("kind", ["zip", "tar", "tar.gz", "tar.xz"])
def test_a_damaged_archive_gives_the_scene_or_one_sentence(tmp_path: Path, kind: str) -> None:
    rng = random.Random(kind)
    if kind == "zip":
        whole = write_zip(tmp_path / "a", in_folder("truck")).read_bytes()
    else:
        whole = gzip.decompress(write_tar(tmp_path / "a", in_folder("truck"), {"truck/link": "x"}).read_bytes())
        whole = {"tar": bytes, "tar.gz": gzip.compress, "tar.xz": lzma.compress}[kind](whole)
    for number in range(200):
        data = bytearray(whole)
        for _ in range(rng.randrange(1, 6)):
            at = rng.randrange(len(data))
            data[at : at + rng.choice([0, 1, 4])] = rng.choice([b"", b"\0", b"\xff\xff\xff\xff", rng.randbytes(rng.randrange(1, 9))])
        (tmp_path / "a").write_bytes(data)
        try:
            archive.extract(tmp_path / "a", "truck", tmp_path / str(number))
        except RunError as error:
            assert str(error).isprintable() and not (tmp_path / str(number)).exists()
