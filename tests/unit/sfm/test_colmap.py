"""COLMAP in its own process: what it says is passed on, and how it ends is told."""

import pytest

from scene_experts.core.errors import InputError, RunError
from scene_experts.sfm import colmap


@pytest.mark.parametrize(
    ("code", "error", "fact"),
    [
        ("print('{\"step\": \"missing\", \"why\": \"no module\"}')", InputError, "no module"),
        ("import os; print('{\"step\": \"features\"}', flush=True); os.abort()", RunError, "-6"),
        ("import os, signal; os.kill(os.getpid(), signal.SIGKILL)", RunError, "memory is full"),
        ("import sys; sys.exit('E20261122 10:00 1 sqlite.h:9] disk is full')", RunError, "disk is full"),
    ],
)  # fmt: skip
def test_a_failed_worker_is_reported(tmp_path, monkeypatch, code, error, fact):
    (tmp_path / "made_worker").mkdir()
    (tmp_path / "made_worker" / "__init__.py").touch()
    (tmp_path / "made_worker" / "__main__.py").write_text(code)
    monkeypatch.setattr(colmap, "WORKER", "made_worker")
    monkeypatch.setattr(colmap, "ROOT", tmp_path)
    with pytest.raises(error, match=fact):
        colmap.run_worker({"threads": 1, "pairs": ["x" * 200] * 1000}, tmp_path / "colmap.log", lambda _: None, lambda *_: None)


def test_the_worker_is_that_of_this_package(tmp_path, monkeypatch):
    """Another version and a pycolmap that cannot be imported come first on the path."""
    (tmp_path / "scene_experts" / "sfm").mkdir(parents=True)
    for folder in (tmp_path / "scene_experts", tmp_path / "scene_experts" / "sfm"):
        (folder / "__init__.py").touch()
    (tmp_path / "scene_experts" / "sfm" / "worker.py").write_text('print(\'{"step": "done"}\')')
    (tmp_path / "pycolmap.py").write_text("raise ImportError('made so')")
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    with pytest.raises(InputError, match=r"pycolmap cannot be imported \(made so\)"):
        colmap.run_worker({"threads": 1, "seed": 0}, tmp_path / "colmap.log", lambda _: None, lambda *_: None)


def test_each_message_of_the_worker_is_told():
    said, shown = [], []
    messages = [
        {"step": "features", "done": 1, "total": 3},
        {"step": "failed", "mapper": "incremental", "why": "no pair"},
        {"step": "next mapper", "mapper": "incremental", "parts": 2, "posed": 2, "photographs": 6},
        {"step": "weak", "photographs": 4, "pairs": 1200},
        {"step": "unread", "names": ["a.jpg", "b.jpg"]},
        {"step": "stretched", "ratio": 2.5282},
        {"step": "one focal length", "kept": True, "first": False},
        {"step": "one focal length", "kept": False, "first": False},
        {"step": "one first", "narrow": True},
        {"step": "one focal length", "kept": False, "first": True},
        {"step": "done", "registered": []},
    ]
    for message in messages:
        colmap.tell(message, said.append, lambda *work: shown.append(work))
    assert shown == [("features", 1, 3)] and len(said) == 9
    assert "2 of 6" in said[1] and "2 parts" in said[1] and "1,200" in said[2] and "a.jpg, b.jpg" in said[3]
    assert "2.53 times" in said[4] and "is kept" in said[5] and "stretched" in said[6]
    assert "different directions" in said[7] and "two focal lengths are tried" in said[8]
