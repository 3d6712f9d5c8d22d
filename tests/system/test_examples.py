"""The examples run on a shipped capture in thumbnails."""

import os
import runpy
import subprocess
import sys
import tomllib
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

import scene_experts as se
from support.places import DEMO, ROOT

EXAMPLES = ROOT / "examples"


@pytest.fixture(scope="module")
def run(tmp_path_factory) -> se.Run:
    capture = se.load_capture(DEMO / "buddha", resolution="longest:48", max_views=16)
    recipe = se.recipe("moe-gs", iterations=10, **{"scene.voxel_size": 0.1})
    return se.train(recipe, capture, tmp_path_factory.mktemp("run"), progress=False)


@pytest.fixture
def example(monkeypatch, tmp_path):
    """Run an example as a program, in an empty folder."""
    monkeypatch.chdir(tmp_path)

    def call(name: str, *words: object) -> None:
        monkeypatch.setattr(sys, "argv", [name, *map(str, words)])
        runpy.run_path(str(EXAMPLES / f"{name}.py"), run_name="__main__")

    return call


@pytest.fixture
def thumbnails(monkeypatch):
    """Captures load as thumbnails, whatever resolution a program asks for."""
    load = se.load_capture
    monkeypatch.setattr("scene_experts.load_capture", lambda path, **_: load(path, resolution="longest:48", max_views=16))
    monkeypatch.setattr("scene_experts.api.trainer.load_capture", lambda path, **_: load(path, resolution="longest:48", max_views=16))


@pytest.mark.parametrize("path", sorted(EXAMPLES.rglob("*.py")), ids=lambda p: str(p.relative_to(EXAMPLES)))
def test_an_example_says_how_to_run_it(path):
    text = path.read_text()
    assert text.startswith('"""') and (path.name in text or path.parent != EXAMPLES)


def test_render_one_view(run, example):
    example("render_one_view", run.path, "view.png")
    camera = run.test_cameras[0]
    picture = np.asarray(Image.open("view.png"))
    assert picture.shape == (camera.height, 2 * camera.width, 3)
    assert np.array_equal(picture[:, camera.width :], (255 * run.render(camera) + 0.5).astype(np.uint8))


def test_train_and_watch(example, thumbnails, capsys):
    example("train_and_watch", DEMO / "buddha", "run", "--iterations", 4, "--every", 2)
    said = capsys.readouterr().out
    assert "iteration 2: " in said and said.count(" dB") >= 1 and se.open_run("run").step in (2, 4)


def test_sweep_two_numbers(example, thumbnails, capsys):
    example("sweep_two_numbers", DEMO / "buddha", "--iterations", 2, "--experts", 2, 3, "--voxel", 0.1, 0.2)
    rows = [line.split() for line in capsys.readouterr().out.splitlines()[1:]]
    assert [row[:2] for row in rows] == [["2", "0.100"], ["2", "0.200"], ["3", "0.100"], ["3", "0.200"]]
    assert all(float(row[2]) > 0 for row in rows)


def test_orbit_video(run, example):
    example("orbit_video", run.path, "frames", "--frames", 3, "--width", 32, "--height", 18, "--show", "experts")
    assert len(list(Path("frames").glob("*.png"))) == 3


@pytest.mark.slow
@pytest.mark.parametrize(
    ("folder", "recipe", "option"),
    [("new_recipe", "wide-decoders", ("--scene.decoder.width", 3)), ("new_loss", "binary-opacity", ("--loss.binary", 0.5))],
)
def test_new_recipe(tmp_path, folder, recipe, option):
    """The package is installed as pip does it: its module, and a .dist-info folder with its entry points."""
    project = tomllib.loads((EXAMPLES / folder / "pyproject.toml").read_text())["project"]
    (group, entries), info = next(iter(project["entry-points"].items())), tmp_path / f"{recipe.replace('-', '_')}-0.1.0.dist-info"
    info.mkdir()
    info.joinpath("METADATA").write_text(f"Metadata-Version: 2.1\nName: {project['name']}\nVersion: {project['version']}\n")
    info.joinpath("entry_points.txt").write_text(f"[{group}]\n" + "".join(f"{name} = {place}\n" for name, place in entries.items()))
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(EXAMPLES / folder), str(tmp_path), *filter(None, sys.path)])}

    def call(*words: object) -> str:
        command = [sys.executable, "-m", "scene_experts", *map(str, words)]
        done = subprocess.run(command, env=environment, capture_output=True, text=True, cwd=tmp_path, timeout=300)
        assert done.returncode == 0, done.stderr
        return done.stdout

    size = ("--resolution", "longest:48", "--max-views", 16, "--iterations", 3, "--scene.voxel-size", 0.2)
    call("train", recipe, "--data", DEMO / "buddha", "--out", "run", *size, *option)
    if folder == "new_recipe":
        call("eval", "run", "--no-lpips")
    assert recipe in (tmp_path / "run" / "config.json").read_text()
