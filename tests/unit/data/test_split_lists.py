"""Lists of training and test photographs beside a reconstruction."""

from __future__ import annotations

import shutil
import unicodedata
from dataclasses import replace
from pathlib import Path

import pytest

from scene_experts.core.errors import InputError
from scene_experts.data.readers.colmap_model import read_model, write_model
from scene_experts.data.views import Capture
from support.captures import load
from support.synthetic import make_capture, make_nerfstudio

NAMES = [f"view_{i:03d}.png" for i in range(10)]


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make_capture(tmp_path_factory.mktemp("made"), views=10, size=(24, 16), points=50).folder


@pytest.fixture
def copy(made: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(made, tmp_path / "copy"))


def held(capture: Capture) -> list[str]:
    return [capture.views[i].name for i in capture.test]


@pytest.mark.parametrize("place", ["sparse/0/test.txt", "sparse/0/test_list.txt", "test_list.txt", "test.txt"])
@pytest.mark.parametrize("form", ["{}\n", "images/{}\r\n", "./{}\n\n", "\ufeff# held out\n{}\n"])
def test_a_list_of_test_photographs(copy: Path, place: str, form: str) -> None:
    (copy / place).write_bytes("".join(form.format(name) for name in NAMES[1:4]).replace("\n\ufeff", "\n").encode())
    capture = load(copy)
    assert held(capture) == NAMES[1:4] and capture.split == "files" and len(capture.train) == 7
    assert any(place in w and "3 of 10" in w and "--split" in w for w in capture.warnings)
    assert load(copy, split="mod8").split == "mod8" and len(load(copy, split="mod5").test) == 2
    assert len(load(copy, split="files").test) == 3


def test_names_without_extension_and_unknown_names(copy: Path) -> None:
    (copy / "sparse/0/test.txt").write_text("view_002\nview_099.png\nsub/view_003.JPG\nview_004.1\n")
    capture = load(copy)
    assert held(capture) == ["view_002.png", "view_003.png"]
    assert any("2 of 4 names" in w and "view_099.png" in w for w in capture.warnings)


def test_both_lists_leave_the_others_out(copy: Path) -> None:
    (copy / "test_list.txt").write_text("\n".join(NAMES[:2]))
    (copy / "train_list.txt").write_text("\n".join(NAMES[1:7]))
    capture = load(copy)
    assert held(capture) == NAMES[:2] and [v.name for v in capture.views] == NAMES[:7]
    assert any("3 in neither list" in w for w in capture.warnings) and any("1 photographs are in both" in w for w in capture.warnings)
    assert len(load(copy, split="mod8").views) == 10


def test_a_list_of_training_photographs_alone(copy: Path) -> None:
    (copy / "train_list.txt").write_text("\n".join(NAMES[:7]))
    assert held(load(copy)) == NAMES[7:]


def test_a_list_of_other_things_is_told_and_not_used(copy: Path) -> None:
    (copy / "test.txt").write_text("hello\nworld\n")
    capture = load(copy)
    assert capture.split == "mod8" and any("test.txt names no photograph" in w for w in capture.warnings)
    with pytest.raises(InputError, match="--split"):
        load(copy, split="files")


def test_the_capture_s_own_split_comes_first(tmp_path: Path) -> None:
    make_nerfstudio(tmp_path, views=5, size=(24, 16), points=50)
    text = (tmp_path / "transforms.json").read_text()
    (tmp_path / "transforms.json").write_text(text.replace('"ply_file_path"', '"test_filenames": ["images/view_001.png"], "ply_file_path"'))
    (tmp_path / "test.txt").write_text("view_003.png\n")
    capture = load(tmp_path)
    assert held(capture) == ["images/view_001.png"] and any("test.txt is not used" in w for w in capture.warnings)


def test_the_list_of_the_chosen_reconstruction(copy: Path) -> None:
    model = read_model(copy / "sparse/0")
    write_model(copy / "sparse/1", replace(model, images=model.images[:5]))
    (copy / "sparse/1/test.txt").write_text(NAMES[2])
    assert load(copy).split == "mod8" and held(load(copy, model="sparse/1")) == [NAMES[2]]


def test_names_that_need_a_folder_and_other_forms_of_unicode(copy: Path) -> None:
    model = read_model(copy / "sparse/0")
    names = ["a/x.png", "b/x.png", "K\u00fcche.png", *NAMES[3:]]
    images = [replace(image, name=name) for image, name in zip(model.images, names)]
    write_model(copy / "sparse/0", replace(model, images=tuple(images)))
    for old, new in zip(NAMES, names):
        (copy / "images" / new).parent.mkdir(exist_ok=True)
        (copy / "images" / old).rename(copy / "images" / new)
    (copy / "test.txt").write_text("x.png\nb/x.png\n" + unicodedata.normalize("NFD", "K\u00fcche.png"))
    capture = load(copy)
    assert held(capture) == ["K\u00fcche.png", "b/x.png"] and any("1 of 3 names" in w and "x.png" in w for w in capture.warnings)
