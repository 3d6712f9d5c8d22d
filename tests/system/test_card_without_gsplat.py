"""Every command on a machine with a CUDA device and without gsplat: none fails for what only training on the device needs."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest
import torch

from scene_experts import cli
from scene_experts.api import backend
from scene_experts.render import gsplat_install
from support.photos import fake_worker, write_black
from support.synthetic import make_capture

POSED = {"with_pose": 3, "photographs": 3, "without_pose": [], "points": 9, "observations": 9.0, "error": 0.5, "mapper": "global"}


@pytest.fixture(autouse=True)
def card(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setitem(sys.modules, "gsplat", None)
    for cached in (gsplat_install.explain_missing, backend._warn):
        cached.cache_clear()
    yield
    for cached in (gsplat_install.explain_missing, backend._warn):
        cached.cache_clear()


@pytest.fixture(scope="module")
def box(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A capture, and a run of it that was trained and scored on a machine without a card."""
    folder = tmp_path_factory.mktemp("card")
    capture = make_capture(folder / "capture", views=9, size=(48, 32)).folder
    run = str(folder / "run")
    assert cli.main(["train", "3dgs", "--data", str(capture), "--out", run, "--iterations", "12"]) == 0
    assert cli.main(["eval", run, "--no-lpips"]) == 0
    assert cli.main(["export", run, "--format", "ply", "--out", str(folder / "scene.ply")]) == 0
    return folder


@pytest.mark.filterwarnings("ignore:the GPU is not used")
@pytest.mark.parametrize(
    "words",
    [
        "info {box}/capture",
        "train scaffold-gs --data {box}/capture --out {new}/run --iterations 12",
        "eval {box}/run --no-lpips",
        "compare {box}/run {box}/run",
        "render {box}/run --out {new}/frames --seconds 0.1",
        "report {box}/run --out {new}/page.html",
        "export {box}/run --format ply --out {new}/scene.ply",
        "import {box}/scene.ply --data {box}/capture --out {new}/imported",
        "bench --seconds 2",
        "catalog",
        "doctor",
    ],
    ids=lambda words: words.split()[0],
)
def test_a_command_works(words: str, box: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    code = cli.main(words.format(box=box, new=tmp_path).split())
    out, err = capsys.readouterr()
    assert code == 0, err
    if words.startswith("info"):
        assert "next: scene-experts train" in out


def test_capture_proposes_a_training(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setattr("scene_experts.sfm.reconstruct.importlib.util.find_spec", lambda name: name)
    note = POSED | {"apart": [], "all_compared": True, "seconds": 1, "registered": ["0.jpg", "1.jpg", "2.jpg"], "cameras": []}
    monkeypatch.setattr("scene_experts.sfm.reconstruct.run_worker", fake_worker(**note))
    assert cli.main(["capture", str(write_black(tmp_path / "photos")), "--out", str(tmp_path / "box")]) == 0
    assert "scene-experts train" in capsys.readouterr().out


def test_training_on_the_card_says_what_is_missing(box: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words = ["train", "scaffold-gs", "--data", str(box / "capture"), "--out", str(tmp_path / "run"), "--device", "cuda"]
    assert cli.main(words) == 2
    error = capsys.readouterr().err
    assert "gsplat" in error and "pip install" in error and "--device cpu" in error
