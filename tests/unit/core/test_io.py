"""Files appear whole or not at all, and every failure is one sentence."""

import errno
import os
import resource
import stat
from pathlib import Path

import pytest

from scene_experts.core import io
from scene_experts.core.errors import InputError, RunError
from scene_experts.core.io import locked, read_json, write_atomic, write_bytes, write_json
from support.messages import naming

NO_LOCKS = (errno.ENOLCK, errno.ENOSYS, errno.ENOTSUP, errno.EOPNOTSUPP)


def names(folder):
    return sorted(p.name for p in folder.iterdir())


def test_bytes_into_folders_that_do_not_exist_yet(tmp_path):
    write_bytes(tmp_path / "a" / "b" / "c.bin", b"\0\1")
    assert (tmp_path / "a" / "b" / "c.bin").read_bytes() == b"\0\1" and names(tmp_path / "a" / "b") == ["c.bin"]


def test_the_old_file_stays_until_the_new_one_is_whole(tmp_path):
    path = tmp_path / "x"
    path.write_text("old")

    def write(temporary):
        assert path.read_text() == "old" and temporary.parent == path.parent
        temporary.write_text("new")
        assert path.read_text() == "old"

    write_atomic(path, write)
    assert path.read_text() == "new" and names(tmp_path) == ["x"]


@pytest.mark.parametrize("error", [OSError(28, "No space left on device"), OSError(13, "Permission denied"), OSError("only a text")])
def test_a_failed_write_is_a_run_error_and_leaves_the_old_file(tmp_path, error):
    path = tmp_path / "x"
    path.write_text("old")

    def write(temporary):
        temporary.write_text("half")
        raise error

    with pytest.raises(RunError, match=naming(path, "another folder")):
        write_atomic(path, write)
    assert path.read_text() == "old" and names(tmp_path) == ["x"]


def test_a_bug_while_writing_is_not_hidden_and_leaves_nothing(tmp_path):
    with pytest.raises(ZeroDivisionError):
        write_atomic(tmp_path / "x", lambda temporary: 1 / 0)
    assert names(tmp_path) == []


def test_a_full_disk(tmp_path):
    write_bytes(tmp_path / "x", b"old")
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (1000, hard))
    try:
        with pytest.raises(RunError, match=naming("x")):
            write_bytes(tmp_path / "x", bytes(2000))
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert (tmp_path / "x").read_bytes() == b"old" and names(tmp_path) == ["x"]


def test_a_folder_that_cannot_be_made(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(RunError, match="another folder"):
        write_bytes(tmp_path / "file" / "x", b"")


def test_permissions_follow_the_umask(tmp_path):
    before = os.umask(0o027)
    try:
        write_bytes(tmp_path / "x", b"")
    finally:
        os.umask(before)
    assert stat.S_IMODE((tmp_path / "x").stat().st_mode) == 0o640


def test_json_both_ways(tmp_path):
    value = {"a": [1, 2.5, None, True], "é": {"b": "c"}}
    write_json(tmp_path / "x.json", value)
    assert read_json(tmp_path / "x.json", "thing") == value
    with pytest.raises(ValueError, match="JSON"):
        write_json(tmp_path / "x.json", float("nan"))
    assert read_json(tmp_path / "x.json", "thing") == value


def test_json_of_other_tools(tmp_path):
    (tmp_path / "x.json").write_bytes(b"\xef\xbb\xbf" + '{"é": 1}'.encode())
    assert read_json(tmp_path / "x.json", "thing") == {"é": 1}


@pytest.mark.parametrize("data", [b"", b"{", b'{"a": 1', b"\xff\xfe\x00"])
def test_unreadable_json(tmp_path, data):
    (tmp_path / "x.json").write_bytes(data)
    with pytest.raises(InputError, match=naming("JSON", "x.json")):
        read_json(tmp_path / "x.json", "run configuration")


def test_absent_json(tmp_path):
    with pytest.raises(InputError, match=naming("x.json")):
        read_json(tmp_path / "x.json", "run configuration")


def test_cache_folders(monkeypatch, tmp_path):
    monkeypatch.setattr(io.sys, "platform", "linux")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    assert io.cache_dir() == tmp_path / "scene-experts"
    monkeypatch.delenv("XDG_CACHE_HOME")
    assert io.cache_dir() == Path.home() / ".cache" / "scene-experts"
    monkeypatch.setattr(io.sys, "platform", "darwin")
    assert io.cache_dir() == Path.home() / "Library" / "Caches" / "scene-experts"


def test_a_lock_is_held_once_and_let_go(tmp_path):
    with locked(tmp_path / ".lock", "busy"), pytest.raises(InputError, match="busy"), locked(tmp_path / ".lock", "busy"):
        pass
    with locked(tmp_path / ".lock", "busy"):
        pass


@pytest.mark.parametrize("error", [NotImplementedError(), *(OSError(number, "") for number in NO_LOCKS)])
def test_a_file_system_without_locks_is_told_of_and_holds_nothing_up(error, tmp_path, monkeypatch, caplog):
    def refuse(self, blocking):
        raise error

    monkeypatch.setattr(io.FileLock, "acquire", refuse)
    with locked(tmp_path / ".lock", "busy"), locked(tmp_path / ".lock", "busy"):
        pass
    assert str(tmp_path) in caplog.text and "without locks" in caplog.text


@pytest.mark.parametrize("number", NO_LOCKS)
def test_the_system_call_refuses_locks(number, tmp_path, monkeypatch, caplog):
    """The library of the locks is between: some of its versions use a lock of another kind instead."""
    fcntl = pytest.importorskip("fcntl")

    def refuse(*_):
        raise OSError(number, "no locks here")

    monkeypatch.setattr(fcntl, "flock", refuse)
    with locked(tmp_path / ".lock", "busy"):
        pass
    assert "without locks" in caplog.text


def test_another_error_of_a_lock_is_told(tmp_path, monkeypatch):
    def refuse(self, blocking):
        raise OSError(errno.ENOSPC, "no space")

    monkeypatch.setattr(io.FileLock, "acquire", refuse)
    with pytest.raises(RunError, match=naming(tmp_path / ".lock")), locked(tmp_path / ".lock", "busy"):
        pass
