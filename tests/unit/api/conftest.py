"""A small capture and a short training of it, shared by the tests of the Python API."""

from pathlib import Path

import pytest

import scene_experts as se
from support.synthetic import make_capture

SMALL = {"iterations": 6, "scene.voxel_size": 0.2}


@pytest.fixture(scope="session")
def folder(tmp_path_factory) -> Path:
    return make_capture(tmp_path_factory.mktemp("captures") / "balls", views=9, size=(32, 24), points=200, scale=2.5).folder


@pytest.fixture(scope="session")
def capture(folder) -> se.Capture:
    return se.load_capture(folder)


@pytest.fixture(scope="session")
def small() -> se.Recipe:
    return se.recipe("moe-gs", **SMALL)


@pytest.fixture(scope="session")
def run(tmp_path_factory, capture, small) -> se.Run:
    return se.train(small, capture, tmp_path_factory.mktemp("runs") / "moe", progress=False)
