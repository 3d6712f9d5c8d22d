"""COLMAP captures: the reconstruction and the photographs that belong to it."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from scene_experts.core.errors import InputError
from scene_experts.data.readers.colmap import READER
from scene_experts.data.readers.colmap_model import read_model, write_model
from scene_experts.data.readers.reader import ReadOptions
from support.captures import load
from support.messages import naming
from support.synthetic import Synthetic, make_capture


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Synthetic:
    return make_capture(tmp_path_factory.mktemp("made"), views=10, size=(48, 32), points=300)


@pytest.fixture
def copy(made: Synthetic, tmp_path: Path) -> Path:
    return Path(shutil.copytree(made.folder, tmp_path / "copy"))


def test_a_reconstruction_states_neither_split_nor_bounds(made: Synthetic) -> None:
    raw = READER.read(made.folder, ReadOptions())
    assert [image.name for image in raw.images] == sorted(made.images) and not any(image.test for image in raw.images)
    assert raw.alpha_over is None and raw.bounds is None and not raw.states_split and "points3D" in raw.points_source


def test_text_models_load_like_binary_ones(made: Synthetic, copy: Path) -> None:
    model = read_model(copy / "sparse/0")
    shutil.rmtree(copy / "sparse/0")
    write_model(copy / "sparse/0", model, text=True)
    a, b = load(made.folder), load(copy)
    assert all(torch.equal(v.camera.world_to_cam, w.camera.world_to_cam) for v, w in zip(a.views, b.views))
    assert a.points is not None and b.points is not None and torch.equal(a.points.xyz, b.points.xyz)


def test_absent_images(copy: Path) -> None:
    for i in (3, 5):
        (copy / f"images/view_{i:03d}.png").unlink()
    with pytest.raises(InputError, match=naming(10, 2, "view_003.png", "--missing drop")):
        load(copy)
    capture = load(copy, missing="drop")
    assert len(capture.views) == 8 and any("2" in w and "10" in w for w in capture.warnings)
    shutil.rmtree(copy / "images")
    with pytest.raises(InputError, match="10"):
        load(copy, missing="drop")


def test_the_same_image_twice(copy: Path) -> None:
    model = read_model(copy / "sparse/0")
    write_model(copy / "sparse/0", replace(model, images=(*model.images, replace(model.images[0], id=99))))
    with pytest.raises(InputError):
        load(copy)


def test_several_reconstructions(copy: Path) -> None:
    shutil.copytree(copy / "sparse/0", copy / "sparse/1")
    assert any("2 reconstructions" in w for w in load(copy).warnings)


@pytest.mark.parametrize("part", ["cameras.bin", "images.bin", "points3D.bin"])
def test_truncated_models(copy: Path, part: str) -> None:
    path = copy / "sparse/0" / part
    path.write_bytes(path.read_bytes()[:-5])
    with pytest.raises(InputError, match=part):
        load(copy)
