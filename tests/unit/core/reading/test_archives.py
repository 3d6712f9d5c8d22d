"""Members of zip archives: limits on their number, their bytes and their compression."""

import random
import zipfile

import pytest

from scene_experts.core.errors import InputError
from scene_experts.core.reading.archives import open_zip, zip_names
from scene_experts.core.reading.budget import Budget, Damaged
from scene_experts.core.reading.source import opening
from support.messages import naming

SMALL = Budget("test archive", 1 << 20, floor=10_000, ratio=2, items=3)


def member(path, name="a", limit=10_000):
    with opening(path, SMALL) as source, open_zip(source) as archive:
        return archive.read(name, limit)


def make(path, method=zipfile.ZIP_DEFLATED, **members):
    with zipfile.ZipFile(path, "w", method) as archive:
        for name, data in members.items():
            archive.writestr(name, data)
    return path


def test_a_member(tmp_path):
    path = make(tmp_path / "z", a=b"x" * 5000, b=b"y")
    assert member(path) == b"x" * 5000
    with opening(path, SMALL) as source:
        assert zip_names(source) == ["a", "b"]


def test_members_that_are_refused(tmp_path):
    cases = [
        (make(tmp_path / "0", a=b"x" * 20_000), "20,000"),  # a bomb
        (make(tmp_path / "1", a=b"", b=b"", c=b"", d=b""), "3"),
        (make(tmp_path / "2", b=b""), "a"),
        (make(tmp_path / "3", zipfile.ZIP_LZMA, a=b"x"), "compression"),
    ]
    for path, fact in cases:
        with pytest.raises(InputError, match=naming(path, fact)):
            member(path, limit=1 << 20)
    with pytest.raises(InputError, match=naming("5,000", "4,999")):
        member(make(tmp_path / "4", a=b"x" * 5000), limit=4_999)
    with pytest.raises(InputError):
        member(make(tmp_path / "5", a=b"x"), name=["a"])


def test_a_file_that_declares_other_sizes(tmp_path):
    data = make(tmp_path / "z", zipfile.ZIP_STORED, a=b"x" * 100).read_bytes()
    at = data.index(b"PK\x05\x06")
    for broken in (data[:-30], data[:50], data[: at + 12] + b"\xff\xff\xff\x7f" + data[at + 16 :], data.replace(b"xxx", b"xyx")):
        (tmp_path / "b").write_bytes(broken)
        with pytest.raises(InputError, match=naming("b", "test archive")):
            member(tmp_path / "b")


def test_members_are_unpacked_within_the_budget(tmp_path):
    zeros, noise = bytes(1 << 20), random.Random(0).randbytes(1 << 20)
    with zipfile.ZipFile(tmp_path / "a.zip", "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("zeros", zeros)
        archive.writestr("noise", noise)
    with opening(tmp_path / "a.zip", Budget("zip", 1 << 30, floor=1 << 20, ratio=1)) as source, open_zip(source) as archive:
        archive.unpack("zeros", tmp_path / "out")
        assert (tmp_path / "out").read_bytes() == zeros
        archive.unpack("noise", tmp_path / "out")
        assert (tmp_path / "out").read_bytes() == noise
        for name in ("zeros", "absent", 3):
            with pytest.raises(Damaged):
                archive.unpack(name, tmp_path / "out")
