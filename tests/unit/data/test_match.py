"""Images and masks are found by name."""

from __future__ import annotations

import unicodedata
from pathlib import Path

import pytest

from scene_experts.data.match import NameIndex, absent_error, find_file, list_pictures, match_images, to_relative_name


def touch(root: Path, *names: str) -> None:
    for name in names:
        (root / name).parent.mkdir(parents=True, exist_ok=True)
        (root / name).touch()


def test_exact_names_with_folders_and_dots(tmp_path: Path) -> None:
    touch(tmp_path, "left/a.1.jpg", "left/a.2.jpg", "right/a.1.jpg")
    names = ["left/a.1.jpg", "left/a.2.jpg", "right/a.1.jpg"]
    match = match_images(tmp_path, names)
    assert match.found == {name: tmp_path / name for name in names} and not match.warnings and not match.absent


def test_another_extension_when_there_is_one_choice(tmp_path: Path) -> None:
    touch(tmp_path, "a.png", "b.png", "b.webp")
    match = match_images(tmp_path, ["a.JPG", "b.JPG"])
    assert match.found == {"a.JPG": tmp_path / "a.png"} and match.absent == ("b.JPG",)
    assert len(match.warnings) == 1 and "a.JPG" in match.warnings[0] and "a.png" in match.warnings[0]


@pytest.mark.parametrize(("named", "stored"), [("NFC", "NFD"), ("NFD", "NFC")])
def test_names_in_another_form_of_unicode(tmp_path: Path, named: str, stored: str) -> None:
    """macOS unpacks names decomposed, which look the same."""
    names = [unicodedata.normalize(named, f"Caf\u00e9/K\u00fcche {i}.jpg") for i in range(2)]
    files = [unicodedata.normalize(stored, name) for name in names]
    touch(tmp_path, *files)
    match = match_images(tmp_path, names)
    assert match.found == {name: tmp_path / file for name, file in zip(names, files)} and not match.absent and not match.warnings
    assert [find_file(tmp_path, name) for name in names] == [tmp_path / file for file in files]
    assert match_images(tmp_path, [names[0].replace(".jpg", ".png")]).found == {names[0].replace(".jpg", ".png"): tmp_path / files[0]}
    assert find_file(tmp_path, names[0] + "x") is None and find_file(tmp_path, "none/\u00e9.jpg") is None


def test_names_of_windows(tmp_path: Path) -> None:
    touch(tmp_path, "cam0/a.jpg", "cam1/a.jpg")
    match = match_images(tmp_path, ["cam0\\a.jpg", "cam1\\a.jpg"])
    assert match.found == {f"cam{i}\\a.jpg": tmp_path / f"cam{i}/a.jpg" for i in (0, 1)} and not match.absent


def test_the_exact_form_comes_first(tmp_path: Path) -> None:
    both = [unicodedata.normalize(form, "K\u00fcche.jpg") for form in ("NFC", "NFD")]
    touch(tmp_path, *both)
    if len(list(tmp_path.iterdir())) == 2:  # not on file systems that compare names under one form
        assert match_images(tmp_path, both).found == {name: tmp_path / name for name in both}


def test_one_photograph_is_not_two_views(tmp_path: Path) -> None:
    touch(tmp_path, "a.jpg")
    match = match_images(tmp_path, ["a.jpg", "a.png"])
    assert match.found == {"a.jpg": tmp_path / "a.jpg"} and match.absent == ("a.png",)


@pytest.mark.parametrize(
    ("name", "plain"),
    [
        ("left/a.1.jpg", "left/a.1.jpg"),
        ("./images/a.png", "images/a.png"),
        ("../../images/a.png", "images/a.png"),
        ("/home/me/a.png", "home/me/a.png"),
        ("images/../../a.png", "images/a.png"),
        ("C:\\photos\\a.png", "photos/a.png"),
    ],
)
def test_a_relative_name_stays_inside_any_folder(name: str, plain: str) -> None:
    assert to_relative_name(name) == plain


def test_flattened_folders_when_base_names_are_unique(tmp_path: Path) -> None:
    touch(tmp_path, "a.jpg", "b.jpg")
    match = match_images(tmp_path, ["images/a.jpg", "x/b.jpg", "y/b.jpg"])
    assert match.found == {"images/a.jpg": tmp_path / "a.jpg"} and match.absent == ("x/b.jpg", "y/b.jpg")
    assert "another folder" in match.warnings[0]


def test_names_as_people_write_them() -> None:
    index = NameIndex(["a/one.JPG", "b/one.JPG", "two.jpg", "two.png", "c/caf\u00e9.jpg"])
    for written in ("a/one.JPG", "a/one", "a\\one.jpg", "./a/one.png", "photos/a/one.JPG"):
        assert index.find(written) == {"a/one.JPG"}, written
    assert index.find("cafe\u0301") == {"c/caf\u00e9.jpg"}
    assert index.find("two.png") == {"two.png"}
    assert index.find("one") == index.find("one.JPG") == {"a/one.JPG", "b/one.JPG"}
    assert index.find("two") == {"two.jpg", "two.png"}
    assert index.find("three") == index.find("") == set()


def test_a_photograph_of_another_folder_is_another_one() -> None:
    index = NameIndex(["images/cam1/0001.jpg", "images/cam1/0002.jpg", "images/cam2/0002.jpg"])
    assert index.find("cam1/0002.jpg") == index.find("cam1/0002") == {"images/cam1/0002.jpg"}
    assert index.find("0001.png") == index.find("/data/images/cam1/0001.jpg") == {"images/cam1/0001.jpg"}
    assert index.find("cam2/0001.jpg") == index.find("images/cam2/0001") == set()
    other = NameIndex(["images_4/cam1/0004.jpg", "images_4/cam2/0004.jpg"])  # all are in another folder than written
    assert other.find("images/cam1/0004.jpg") == other.find("/mnt/b/cam1/0004.png") == {"images_4/cam1/0004.jpg"}
    some = NameIndex(["0001.jpg", "cam1/0001.jpg", "0003.jpg"])  # one at the top contradicts no folder, and is not preferred
    assert some.find("cam2/0001.jpg") == {"0001.jpg", "cam1/0001.jpg"} and some.find("images/0003.jpg") == {"0003.jpg"}
    flat = NameIndex(["images/0001.jpg", "images/0002.jpg"])
    assert flat.find("cam/0001.jpg") == flat.find("images_4/0001.png") == {"images/0001.jpg"}


def test_an_absent_image_is_reported(tmp_path: Path) -> None:
    match = match_images(tmp_path / "none", ["a.jpg"])
    assert match.absent == ("a.jpg",)
    text = str(absent_error(tmp_path, ["a.jpg", "b.jpg"], match.absent))
    assert "2" in text and "a.jpg" in text and "--images" in text


def test_pictures_behind_links_are_listed_once(tmp_path: Path) -> None:
    touch(tmp_path, "elsewhere/1.png", "masks/2.png")
    (tmp_path / "masks" / "cam1").symlink_to(tmp_path / "elsewhere")
    (tmp_path / "elsewhere" / "loop").symlink_to(tmp_path / "masks")
    assert list_pictures(tmp_path / "masks") == ["2.png", "cam1/1.png"]
    assert list_pictures(tmp_path / "masks", deep=False) == ["2.png"]
