"""Opening files within a budget: absent, special and growing files, and one sentence for every failure."""

import json
import os
import zlib

import pytest

from scene_experts.core.errors import InputError, RunError
from scene_experts.core.reading.budget import Budget, CutShort, Damaged
from scene_experts.core.reading.source import describe, guarding, inside, opening, shorten
from support.messages import naming

SMALL = Budget("test file", bytes_in=100, floor=1000, ratio=10, items=5, seconds=0.0)


def test_a_file_within_its_budget(tmp_path):
    (tmp_path / "a").write_bytes(b"x" * 100)
    with opening(tmp_path / "a", SMALL) as source:
        assert source.read() == b"x" * 100 and source.head(3) == b"xxx" and source.size == 100
        source.spend_bytes(1900)
        source.spend_bytes(100)
        with pytest.raises(Damaged, match=naming(100, "2,001")):
            source.spend_bytes(1)


def test_what_is_beyond_it(tmp_path):
    (tmp_path / "a").write_bytes(b"x" * 101)
    with pytest.raises(InputError, match=naming("a", 101, 100)), opening(tmp_path / "a", SMALL):
        raise AssertionError
    (tmp_path / "a").write_bytes(b"x")
    with pytest.raises(InputError, match=naming("test file", 5)), opening(tmp_path / "a", SMALL) as source:
        source.spend_items(6)
    with pytest.raises(InputError, match=naming("test file", "s to read")), opening(tmp_path / "a", SMALL) as source:
        while True:
            source.check_time()
    with pytest.raises(InputError, match="grows"), opening(tmp_path / "a", SMALL) as source:
        (tmp_path / "a").write_bytes(b"xx")
        source.read()


def test_absent_and_special_files(tmp_path):
    os.mkfifo(tmp_path / "pipe")
    for name, fact in (("absent", "no such file"), ("pipe", "no regular file"), (".", "a folder"), ("a\0b", "null")):
        with pytest.raises(InputError, match=fact), opening(tmp_path / name, SMALL):
            raise AssertionError
    with pytest.raises(InputError, match=naming("record of a run")), opening(tmp_path / "absent", SMALL, "record of a run"):
        raise AssertionError


ERRORS = [KeyError("k"), RecursionError(), MemoryError(), OSError("x"), OSError(28, "full"), AssertionError(), Damaged("d")]


@pytest.mark.parametrize("error", ERRORS, ids=lambda e: type(e).__name__)
def test_every_failure_is_one_sentence(error):
    with pytest.raises(InputError, match="there") as found, guarding("there", SMALL):
        raise error
    assert "\n" not in str(found.value) and found.value.__cause__ is error


def test_what_passes():
    for error in (InputError("a"), RunError("b"), KeyboardInterrupt()):
        with pytest.raises(type(error)) as found, guarding("there", SMALL):
            raise error
        assert found.value is error


def test_sentences_that_quote_a_file_are_short_and_on_one_line():
    with pytest.raises(InputError) as found, guarding("there", SMALL):
        raise InputError("found 'a\n\x1b[31m" + "x" * 100_000)
    assert len(str(found.value)) <= 2000 and str(found.value).isprintable()


def test_causes_are_short_and_on_one_line():
    assert shorten("a\n\x1b[31mb\u202e") == "a [31mb"
    assert len(describe(ValueError("x" * 10_000))) < 250


def test_names_stay_inside_their_folder(tmp_path):
    (tmp_path / "run" / "test").mkdir(parents=True)
    (tmp_path / "run" / "out").symlink_to(tmp_path)
    assert inside(tmp_path / "run", "test/../test/a.png").name == "a.png"
    for name in ("../a", "/etc/passwd", "out/a", "a/../../b", "", None, 3, "a\0"):
        with pytest.raises(Damaged):
            inside(tmp_path / "run", name)


READ = Budget("test file", bytes_in=100, other="convert it")


@pytest.mark.parametrize(
    ("error", "cut"),
    [
        (CutShort("3 bytes"), True),
        (EOFError(), True),
        (zlib.error("incomplete"), True),
        (json.JSONDecodeError("Expecting value", "[1, ", 4), True),
        (json.JSONDecodeError("Expecting value", "[1, x]", 4), False),
        (Damaged("version 9"), False),
        (KeyError("count"), False),
        (TypeError("list"), False),
    ],
    ids=lambda value: type(value).__name__,
)
def test_only_a_file_that_lacks_bytes_is_to_be_copied_again(error, cut):
    with pytest.raises(InputError, match="there") as found, guarding("there", READ):
        raise error
    assert ("copy it again" in str(found.value)) is cut and ("convert it" in str(found.value)) is not cut
    assert "'count'" in str(found.value) or not isinstance(error, KeyError)


def test_parts_of_a_scene_are_files_in_its_folder_and_widen_its_budget(tmp_path):
    (tmp_path / "a").write_bytes(b"x")
    (tmp_path / "sub").mkdir()
    (tmp_path / "sub" / "b").write_bytes(b"y" * 90)
    with opening(tmp_path / "a", READ) as source:
        assert source.part("sub/b") == b"y" * 90 and source.part("sub/../sub/b") is source.part("sub/b")
        assert source.size == 91 and source.items == 1
        with pytest.raises(InputError, match=naming("part of a", "no such file")):
            source.part("c")
        (tmp_path / "d").write_bytes(b"z" * 11)
        with pytest.raises(InputError, match=naming("part of a", 11, 10)):
            source.part("d", 10)
        for name in ("../a", "/etc/hosts", 3):
            with pytest.raises(Damaged):
                source.part(name)
