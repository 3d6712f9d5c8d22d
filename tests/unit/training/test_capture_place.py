"""A run finds its capture."""

from pathlib import Path

import pytest

from scene_experts.training.capture_place import absolute, find, from_run


@pytest.fixture
def room(tmp_path, monkeypatch) -> Path:
    """captures/box beside runs/a/b, seen from another folder."""
    for name in ("captures/box", "runs/a/b", "elsewhere"):
        (tmp_path / name).mkdir(parents=True)
    monkeypatch.chdir(tmp_path / "elsewhere")
    return tmp_path


def test_a_path_without_dots():
    assert absolute(Path("a/../b")) == Path.cwd() / "b"


def test_an_absolute_path_comes_first(room):
    assert find(room / "runs/a", room / "captures/box", "../nowhere") == room / "captures/box"


def test_folders_that_moved_together(room):
    relative = from_run(room / "runs/a", room / "captures/box")
    assert relative == "../../captures/box"
    room.rename(moved := room.with_name("moved"))
    assert find(moved / "runs/a", room / "captures/box", relative) == moved / "captures/box"


def test_a_capture_that_is_gone_keeps_its_path(room):
    assert find(room / "runs/a", Path("gone"), "../gone") == Path("gone")


def test_a_relative_run_folder(room, monkeypatch):
    monkeypatch.chdir(room / "runs")
    assert find(Path("a"), room / "none", "../../captures/box") == room / "captures/box"


def test_drives_without_a_way_between_them(monkeypatch):
    def none(*_):
        raise ValueError

    monkeypatch.setattr("os.path.relpath", none)
    assert from_run(Path("run"), Path("capture")) is None
