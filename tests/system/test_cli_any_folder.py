"""Commands find a run's capture from any folder, and after run and capture have moved together."""

from __future__ import annotations

import json
import os
import shutil
from pathlib import Path

import pytest

from scene_experts import cli
from scene_experts.training import run_folder
from scene_experts.view import server
from support.synthetic import make_capture

TRAIN = ("train", "scaffold-gs", "--data", "box", "--out", "runs/one", "--iterations", "6", "--preview-every", "0", "--save-every", "3")


@pytest.fixture(scope="module")
def home(tmp_path_factory) -> Path:
    """A run that was trained with relative paths, from the folder that holds run and capture."""
    root = tmp_path_factory.mktemp("home")
    make_capture(root / "box", views=9, size=(48, 32), points=300)
    before = Path.cwd()
    os.chdir(root)
    try:
        assert cli.main([*TRAIN, "--stop-at", "3"]) == 0
    finally:
        os.chdir(before)
    return root


@pytest.fixture
def moved(home, tmp_path, monkeypatch) -> Path:
    """Run and capture at another place; the current folder is a third one."""
    (tmp_path / "elsewhere").mkdir()
    place = Path(shutil.copytree(home, tmp_path / "moved"))
    home.rename(hidden := home.with_name("hidden"))  # the path that the run keeps leads nowhere
    monkeypatch.chdir(tmp_path / "elsewhere")
    yield place
    hidden.rename(home)


COMMANDS = {
    "eval": ["eval", "RUN", "--no-lpips"],
    "render": ["render", "RUN", "--size", "32x24", "--seconds", "0.1", "--out", "frames"],
    "export": ["export", "RUN", "--format", "compact", "--out", "scene.compact"],
    "export of Gaussians": ["export", "RUN", "--format", "ply", "--refine", "0", "--out", "scene.ply"],
    "resume": ["train", "scaffold-gs", "--data", "BOX", "--out", "RUN", *TRAIN[6:], "--resume"],
}


@pytest.mark.parametrize("case", list(COMMANDS))
def test_from_another_folder(case, home, tmp_path, monkeypatch):
    run = Path(shutil.copytree(home / "runs/one", tmp_path / "runs/one"))  # without its capture beside it: the path from the root counts
    monkeypatch.chdir(tmp_path)
    words = {"RUN": str(run), "BOX": os.path.relpath(home / "box", tmp_path)}
    assert cli.main([words.get(word, word) for word in COMMANDS[case]]) == 0


@pytest.mark.parametrize("case", [name for name in COMMANDS if name != "resume"])
def test_after_run_and_capture_have_moved(case, moved):
    assert cli.main([str(moved / "runs/one") if word == "RUN" else word for word in COMMANDS[case]]) == 0


def test_report_and_compare(moved, capsys):
    run = os.path.relpath(moved / "runs/one")
    assert cli.main(["eval", run, "--no-lpips"]) == 0
    assert cli.main(["compare", run, run]) == 0 and cli.main(["report", run, "--out", "page.html"]) == 0
    assert Path("page.html").stat().st_size > 1000


def test_view(moved, monkeypatch):
    pytest.importorskip("viser")
    seen = []

    class Page:
        moved, url = False, "http://here"

        def __init__(self, capture, *_, **__):
            seen.append(capture.root)

        def serve(self) -> None: ...

        def close(self) -> None: ...

    monkeypatch.setattr(server, "Viewer", Page)
    assert cli.main(["view", str(moved / "runs/one")]) == 0
    assert [Path(root).resolve() for root in seen] == [(moved / "box").resolve()]


def test_a_capture_that_is_gone_is_asked_for(moved, capsys):
    shutil.rmtree(moved / "box")
    assert cli.main(["eval", str(moved / "runs/one"), "--no-lpips"]) == 2
    assert "--data" in capsys.readouterr().err


def test_what_is_written(home):
    config = json.loads((home / "runs/one/config.json").read_text())
    assert (config["data"]["path"], config["capture_from_run"]) == (str(home / "box"), "../../box")
    assert run_folder.read_config(home / "runs/one").data.path == home / "box"
