"""Photographs that are in a capture twice."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from PIL import Image

from scene_experts.data.readers.colmap_model import read_model, write_model
from support.captures import load
from support.synthetic import make_capture


def told(folder: Path) -> list[str]:
    return [line for line in load(folder).warnings if "copies" in line]


def add(folder: Path, of: int, name: str, picture: Image.Image) -> None:
    """Add a photograph with nearly the pose of another one."""
    model = read_model(folder / "sparse/0")
    old = sorted(model.images, key=lambda image: image.name)[of]
    x, y, z = old.translation
    images = [*model.images, replace(old, id=99, name=name, translation=(x + 1e-3, y, z - 1e-3))]
    write_model(folder / "sparse/0", replace(model, images=images))
    picture.save(folder / "images" / name)


def test_a_copy_is_named_with_its_original(tmp_path: Path) -> None:
    folder = make_capture(tmp_path, views=9, size=(96, 64), mixed_sizes=False).folder
    assert told(folder) == []
    with Image.open(folder / "images" / "view_004.png") as image:
        picture = image.convert("RGB")
    add(folder, 4, "view_004_copy.jpg", picture)
    (line,) = told(folder)
    assert "view_004_copy.jpg of view_004.png" in line and "--leave-out" in line
    assert not [w for w in load(folder, leave_out=("view_004_copy.jpg",)).warnings if "copies" in w]


def test_another_picture_from_the_same_place_is_none(tmp_path: Path) -> None:
    folder = make_capture(tmp_path, views=9, size=(96, 64), mixed_sizes=False).folder
    add(folder, 4, "other.png", Image.new("RGB", (96, 64), (200, 30, 30)))
    assert told(folder) == []
