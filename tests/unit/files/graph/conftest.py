"""Fixtures for the tests of graph files."""

from dataclasses import replace

import pytest

from scene_experts.data.settings import Data
from scene_experts.files.scene_folder import write_result_folder
from scene_experts.render import choose
from scene_experts.training import loop as train
from scene_experts.training import run_folder
from scene_experts.training.config import RunConfig
from scene_experts.training.recipes import RECIPES
from support.captures import load
from support.synthetic import make_capture


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """A short training on a capture that is scaled by 3: the run's folder, the layout's folder and the capture."""
    root = tmp_path_factory.mktemp("graph")
    folder = make_capture(root / "capture", views=9, size=(48, 32), points=150, scale=3.0).folder
    cfg = replace(RECIPES["sags"][1], iterations=60)
    config = RunConfig(cfg, Data(folder))
    run_folder.prepare(root / "run", config, resume=False)
    capture = load(folder)
    list(train.train(cfg, train.Job(config, root / "run"), capture, choose("auto", "cpu")))
    written = write_result_folder(run_folder.open_run(root / "run"), capture)
    capture.images.close()
    return root / "run", written, capture
