"""Photographs found, grouped by camera and copied."""

import numpy as np
import pytest
from PIL import Image

from scene_experts.errors import InputError
from scene_experts.sfm.photos import by_camera, copy, find


def photo(path, size=(40, 30), model="", focal=0.0):
    path.parent.mkdir(parents=True, exist_ok=True)
    exif = Image.Exif()
    if model:
        exif[0x0110] = model
        exif.get_ifd(0x8769)[0x920A] = focal
    Image.fromarray(np.zeros((size[1], size[0], 3), np.uint8)).save(path, exif=exif)
    return path


def test_names_are_in_the_order_of_their_numbers_and_hidden_files_are_none(tmp_path):
    for name in ("10.jpg", "2.jpg", "b/1.png", ".thumbs/1.jpg", "1.JPG"):
        photo(tmp_path / name)
    (tmp_path / "notes.txt").write_text("no photograph")
    assert [p.name for p in find(tmp_path)] == ["1.JPG", "2.jpg", "10.jpg", "b/1.png"]


def test_too_few_or_unreadable_photographs_are_told(tmp_path):
    with pytest.raises(InputError, match="expected a folder of photographs or a video at"):
        find(tmp_path / "none")
    photo(tmp_path / "1.jpg")
    for i in range(4):
        (tmp_path / f"{i}.HEIC").write_bytes(b"")
    with pytest.raises(InputError, match=r"found 1; save the \.heic files as JPEG"):
        find(tmp_path)
    for i in range(3):
        photo(tmp_path / f"{i}.jpg")
    (tmp_path / "2.jpg").write_bytes(b"not a picture")
    with pytest.raises(InputError, match=r"expected a readable image at .*2\.jpg"):
        find(tmp_path)


def test_a_camera_is_one_size_maker_and_focal_length(tmp_path):
    photo(tmp_path / "1.jpg", model="A", focal=4.0)
    photo(tmp_path / "2.jpg", model="A", focal=9.0)
    photo(tmp_path / "3.jpg", model="A", focal=4.0)
    photo(tmp_path / "4.jpg", size=(30, 40), model="A", focal=4.0)
    photo(tmp_path / "5.jpg")
    assert by_camera(find(tmp_path)) == [["1.jpg", "3.jpg"], ["2.jpg"], ["4.jpg"], ["5.jpg"]]


def test_photographs_that_are_shown_turned_are_written_upright(tmp_path):
    source, target = tmp_path / "photos", tmp_path / "images"
    source.mkdir()
    picture = Image.new("RGB", (40, 30))
    picture.paste((255, 0, 0), (0, 0, 40, 10))  # red at the top, which belongs to the right once it is turned
    for i, orientation in enumerate((6, 1, 6)):
        exif = Image.Exif()
        exif[0x0112], exif[0x0110] = orientation, "A"
        picture.save(source / f"{i}.jpg", exif=exif, quality=95)
    for _ in range(2):
        found = copy(find(source), source, target)
    assert [p.size for p in found] == [(30, 40), (40, 30), (30, 40)] and by_camera(found) == [["0.jpg", "2.jpg"], ["1.jpg"]]
    assert find(target) == found
    with Image.open(target / "0.jpg") as turned:
        assert turned.getpixel((28, 20))[0] > 200 and turned.getpixel((2, 20))[0] < 60
    assert (target / "1.jpg").read_bytes() == (source / "1.jpg").read_bytes()
    assert [p.orientation for p in copy(find(source), source, source)] == [6, 1, 6]


def test_copies_have_no_blanks_in_their_names_and_are_made_once(tmp_path):
    source, target = tmp_path / "my photos", tmp_path / "out" / "images"
    for i in range(3):
        photo(source / "a b" / f"IMG ({i}).jpg")
    found = find(source)
    copy(found, source, target)
    there = copy(found, source, target)
    assert sorted(p.name for p in target.rglob("*.jpg")) == ["IMG_(0).jpg", "IMG_(1).jpg", "IMG_(2).jpg"]
    assert by_camera(there) == [["a_b/IMG_(0).jpg", "a_b/IMG_(1).jpg", "a_b/IMG_(2).jpg"]]
    with pytest.raises(InputError, match="expected names without blanks"):
        copy(found, source, source)
    (target / "a_b" / "IMG_(1).jpg").write_bytes(b"another")
    with pytest.raises(InputError, match="found another file; choose another --out"):
        copy(found, source, target)
    photo(source / "a_b" / "IMG (1).jpg")
    with pytest.raises(InputError, match="found 'a b/IMG"):
        find(source)
