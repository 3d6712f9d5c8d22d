"""A capture made of photographs: the poses are those that are known, a stopped one goes on, and nothing is half there."""

import importlib.util
import json
import shutil
from pathlib import Path

import pytest
import torch

from scene_experts.data import load
from scene_experts.errors import InputError, RunError
from scene_experts.sfm import run
from scene_experts.sfm.run import LOG, MODEL, NOTE, WORK, Options
from test_sfm_photos import photo

DEMO = Path(__file__).parent.parent / "demo" / "buddha"
TOGETHER = ["008.jpg", "009.jpg", "017.jpg", "018.jpg", "025.jpg", "043.jpg", "053.jpg", "067.jpg"]  # they show much of each other


def aligned(a: torch.Tensor, b: torch.Tensor) -> torch.Tensor:
    """`a` [V, 3] moved, turned and scaled onto `b` (Umeyama 1991)."""
    from_, to = a - a.mean(0), b - b.mean(0)
    u, s, vh = torch.linalg.svd(to.T @ from_)
    sign = torch.diag(torch.tensor([1.0, 1.0, float(torch.det(u @ vh).sign())], dtype=a.dtype))
    scale = (s * sign.diagonal()).sum() / from_.square().sum()
    return scale * from_ @ (u @ sign @ vh).T + b.mean(0)


def centres(capture, names) -> torch.Tensor:
    by_name = {view.name: view.camera.to(dtype=torch.float64).position for view in capture.views}
    return torch.stack([by_name[name] for name in names])


def test_poses_of_photographs_are_those_that_are_known(tmp_path):
    if importlib.util.find_spec("pycolmap") is None:
        pytest.skip("pycolmap is not installed")
    source, out = tmp_path / "photos", tmp_path / "capture"
    source.mkdir()
    for name in TOGETHER:
        shutil.copy(DEMO / "images" / name, source / name)
    steps = []
    note = run.make(source, out, Options(max_side=640, threads=2), say=lambda _: None, progress=lambda *a: steps.append(a))
    assert note == json.loads((out / NOTE).read_text()) and note["with_pose"] == 8 and note["error"] < 1.0
    assert not (out / WORK).exists() and {s[0] for s in steps} >= {"features", "matches", "poses (incremental)"}
    made, known = load(out, split="none", normalise="none"), load(DEMO, split="none", normalise="none")
    theirs = centres(known, TOGETHER)
    off = (aligned(centres(made, TOGETHER), theirs) - theirs).norm(dim=1)
    assert off.max() < 0.03 * torch.cdist(theirs, theirs).max(), off
    with pytest.raises(InputError, match=r"expected no poses at .* yet"):
        run.make(source, out, Options())


def black(folder: Path, count: int = 3) -> Path:
    for i in range(count):
        photo(folder / f"{i}.jpg", size=(64, 48))
    return folder


def answer(**said):
    """A worker that says this."""

    def reconstructed(request, log, say, progress):
        reconstructed.requests.append(request)
        model = Path(request["sparse"])
        model.mkdir(parents=True, exist_ok=True)
        (model / "cameras.bin").write_bytes(b"new")
        return {"step": "done", "version": "0", "registered": [], **said}

    reconstructed.requests = []
    return reconstructed


def test_photographs_that_fit_nowhere_leave_the_reason_and_no_poses(tmp_path, monkeypatch):
    monkeypatch.setattr(run, "reconstructed", answer())
    with pytest.raises(InputError, match="found none that fit together"):
        run.make(black(tmp_path / "photos"), tmp_path / "out", Options(), say=lambda _: None)
    assert not (tmp_path / "out" / MODEL).exists()


def test_frames_of_a_video_are_taken_once_and_of_another_one_not_at_all(tmp_path, monkeypatch):
    monkeypatch.setattr(run, "reconstructed", answer())
    taken = []

    def take(video, folder, count, progress):
        taken.append(count)
        black(folder)

    monkeypatch.setattr(run.frames, "take", take)
    video = tmp_path / "walk.mp4"
    video.write_bytes(b"frames")
    for options, message in [
        (Options(), "fit together"),
        (Options(), "fit together"),
        (Options(frames=9), "found some; choose another --out"),
    ]:
        with pytest.raises(InputError, match=message):
            run.make(video, tmp_path / "out", options, say=lambda _: None)
    assert taken == [Options().frames]


def test_the_same_request_finds_its_database_again_and_another_does_not(tmp_path, monkeypatch):
    monkeypatch.setattr(run, "reconstructed", answer())
    source, kept = black(tmp_path / "photos"), tmp_path / "out" / WORK / "database.db"

    def ask(options=Options()):  # noqa: B008
        with pytest.raises(InputError):
            run.make(source, tmp_path / "out", options, say=lambda _: None)

    ask()
    kept.write_bytes(b"features")
    ask(Options(matching="sequential"))
    assert kept.exists()
    ask(Options(max_side=800))
    assert not kept.exists()


def test_new_poses_take_the_place_of_old_ones_whole(tmp_path, monkeypatch):
    worker = answer(registered=["0.jpg", "2.jpg"], mapper="incremental", models=[2], points=5, error=0.5, observations=3.0, cameras=[])
    monkeypatch.setattr(run, "reconstructed", worker)
    model = tmp_path / "out" / MODEL
    model.mkdir(parents=True)
    (model / "cameras.txt").write_text("old")
    note = run.make(black(tmp_path / "photos"), tmp_path / "out", Options(), overwrite=True, say=lambda _: None)
    assert [p.name for p in model.iterdir()] == ["cameras.bin"] and list(model.parent.iterdir()) == [model]
    assert note["without_pose"] == ["1.jpg"] and note["with_pose"] == 2
    assert worker.requests[0]["pairs"] == [("0.jpg", "1.jpg"), ("0.jpg", "2.jpg"), ("1.jpg", "2.jpg")]


@pytest.mark.parametrize(
    ("code", "error", "message"),
    [
        ("print('{\"step\": \"missing\", \"why\": \"no module\"}')", InputError, r"expected pycolmap .*no module.*scene-experts\[sfm\]"),
        ("import os; print('{\"step\": \"features\"}', flush=True); os.abort()", RunError, "after 'features'; its words"),
        ("import sys; sys.exit(3)", RunError, "exit code 3 after 'nothing'"),
    ],
)  # fmt: skip
def test_a_worker_that_fails_is_told(tmp_path, monkeypatch, code, error, message):
    (tmp_path / "worker.py").write_text(code)
    monkeypatch.setattr(run.worker, "__file__", str(tmp_path / "worker.py"))
    with pytest.raises(error, match=message):
        run.reconstructed({"threads": 1, "pairs": ["x" * 200] * 1000}, tmp_path / LOG, lambda _: None, lambda *_: None)
