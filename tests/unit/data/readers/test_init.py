"""The list of readers: a reader from outside the package is found, loads a capture and trains on it."""

from __future__ import annotations

import ast
import json
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch

import scene_experts
from scene_experts.core.errors import InputError
from scene_experts.core.types import Points
from scene_experts.data import readers
from scene_experts.data.lens import Lens
from scene_experts.data.readers import PosedImage, RawCapture, ReadOptions
from scene_experts.data.settings import Data
from scene_experts.render import choose
from scene_experts.training.config import RunConfig
from scene_experts.training.events import Finished
from scene_experts.training.job import Job
from scene_experts.training.loop import train
from scene_experts.training.recipes import RECIPES
from support.captures import load
from support.synthetic import make_capture


class PosesReader:
    """Reads a format that this test makes up: poses.json with a pinhole camera and a matrix for each photograph."""

    name = "poses"
    files = "poses.json (a test)"

    def recognise(self, folder: Path) -> bool:
        return (folder / "poses.json").is_file()

    def read(self, folder: Path, options: ReadOptions) -> RawCapture:
        meta = json.loads((folder / "poses.json").read_text())
        images = [
            PosedImage(f["name"], folder / f["name"], Lens(*f["lens"][:3], tuple(f["lens"][3])), np.array(f["pose"]), test=f["test"])
            for f in meta["frames"]
        ]
        points = Points(torch.tensor(meta["xyz"], dtype=torch.float64), torch.tensor(meta["rgb"], dtype=torch.uint8))
        return RawCapture(images, points, [], alpha_over=(0.5, 0.5, 0.5), states_split=True, bounds=((-2, -2, 0), (2, 2, 1)))


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    made = make_capture(tmp_path, views=6, size=(32, 24), points=600)
    frames = []
    for i, image in enumerate(made.model.images):
        lens = made.model.cameras[image.camera_id]
        facts = (lens.model, lens.width, lens.height, lens.params)
        frames.append({"name": f"images/{image.name}", "lens": facts, "pose": image.world_to_cam().tolist(), "test": i == 2})
    meta = {"frames": frames, "xyz": made.model.xyz.tolist(), "rgb": made.model.rgb.tolist()}
    (tmp_path / "poses.json").write_text(json.dumps(meta))
    for path in (tmp_path / "sparse/0").iterdir():
        path.unlink()
    return tmp_path


@pytest.fixture
def registered(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(readers, "_registered", [])
    readers.register(PosesReader())


def test_an_unknown_kind_is_refused_and_known_once_registered(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert not readers.is_capture(folder)
    with pytest.raises(InputError, match="scene-experts capture"):
        load(folder)
    monkeypatch.setattr(readers, "_registered", [])
    readers.register(PosesReader())
    assert readers.is_capture(folder) and "poses.json" in str(readers.unrecognised_error(folder / "nowhere"))


@pytest.mark.usefixtures("registered")
def test_what_a_reader_states_decides_how_its_capture_is_loaded(folder: Path) -> None:
    capture = load(folder)
    assert (capture.kind, capture.split, capture.test) == ("poses", "files", (2,)) and capture.background == (0.5, 0.5, 0.5)
    assert capture.points is not None and len(capture.points.xyz) == 600
    random = load(folder, init="random", background=(0.0, 0.0, 1.0))
    assert random.points is not None and random.background == (0.0, 0.0, 1.0)
    xyz = random.world.to_input(random.points.xyz)
    assert float(xyz.min()) >= -2 and float(xyz[:, 2].min()) > -1e-9 and 0.9 < float(xyz[:, 2].max()) <= 1, "in the stated bounds"


@pytest.mark.usefixtures("registered")
def test_a_training_runs_on_a_capture_of_a_registered_kind(folder: Path) -> None:
    cfg = replace(RECIPES["scaffold-gs"][1], iterations=3)
    events = list(train(cfg, Job(RunConfig(cfg, Data(folder))), load(folder), choose("auto", "cpu")))
    assert isinstance(events[-1], Finished) and events[-1].step == 3


def test_an_installed_package_offers_a_reader(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    entry = SimpleNamespace(name="poses", value="elsewhere:READER", load=PosesReader)
    monkeypatch.setattr(readers, "entry_points", lambda group: [entry] if group == "scene_experts.readers" else [])
    readers._load_installed.cache_clear()
    try:
        assert load(folder).kind == "poses"
        readers._load_installed.cache_clear()
        entry.load = lambda: 1 / 0
        with pytest.raises(InputError, match="elsewhere:READER"):
            load(folder)
    finally:
        readers._load_installed.cache_clear()


def test_a_registered_reader_is_asked_before_the_built_in_ones(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (folder / "transforms.json").write_text("{}")
    monkeypatch.setattr(readers, "_registered", [])
    (before,) = (readers.find_reader(folder),)
    readers.register(PosesReader())
    after = readers.find_reader(folder)
    assert before and after and (before.name, after.name) == ("nerfstudio", "poses")


def test_only_its_reader_knows_the_name_of_a_kind() -> None:
    """Other files read what a capture states and never compare its kind."""
    names = {reader.name for reader in readers._load_built_in()}
    source = Path(scene_experts.__file__).parent
    for path in set(source.rglob("*.py")) - set(Path(readers.__file__).parent.glob("*.py")):
        constants = {node.value for node in ast.walk(ast.parse(path.read_text())) if isinstance(node, ast.Constant)}
        assert not names & {value for value in constants if isinstance(value, str)}, path
