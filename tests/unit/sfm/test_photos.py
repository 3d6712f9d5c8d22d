"""Photographs: finding, grouping by camera, copying."""

import os
import sys

import numpy as np
import pytest
from PIL import Image

from scene_experts.core.errors import InputError
from scene_experts.data.masks import find_masks
from scene_experts.sfm.photos import Photo, check_in_place, copy_photos, decide_round, find_photos, group_by_camera
from support.messages import naming
from support.photos import write_photo, write_turned
from support.rooms import draw_panorama, paint_walls


def test_names_are_sorted_by_their_numbers_and_hidden_files_are_ignored(tmp_path):
    for name in ("10.jpg", "2.jpg", "b/1.png", ".thumbs/1.jpg", "1.JPG"):
        write_photo(tmp_path / name)
    (tmp_path / "notes.txt").write_text("no photograph")
    assert [p.name for p in find_photos(tmp_path)] == ["1.JPG", "2.jpg", "10.jpg", "b/1.png"]


def test_too_few_or_unreadable_photographs_are_reported(tmp_path):
    write_photo(tmp_path / "1.jpg")
    for i in range(4):
        (tmp_path / f"{i}.NEF").write_bytes(b"")
    with pytest.raises(InputError, match=naming(1, ".nef")):
        find_photos(tmp_path)
    for i in range(3):
        write_photo(tmp_path / f"{i}.jpg")
    whole = write_photo(tmp_path / "2.jpg", size=(400, 300)).read_bytes()
    (tmp_path / "2.jpg").write_bytes(whole[: len(whole) // 2])
    with pytest.raises(InputError, match=r"2\.jpg"):
        find_photos(tmp_path)


def test_heic_photographs_are_read_where_pillow_heif_is_installed(tmp_path, monkeypatch):
    heif = pytest.importorskip("pillow_heif")
    heif.register_heif_opener()
    source = tmp_path / "phone"
    source.mkdir()
    for i in range(3):
        Image.new("RGB", (64, 48), (40 * i, 90, 10)).save(source / f"IMG_{i}.HEIC", format="HEIF", quality=90)
    write_photo(source / "IMG_2.jpg")  # the same photograph twice
    found = find_photos(source)
    assert [photo.name for photo in found] == ["IMG_0.HEIC", "IMG_1.HEIC", "IMG_2.jpg"]
    there = copy_photos(found, source, tmp_path / "work" / "images")
    assert [photo.name for photo in there] == ["IMG_0.jpg", "IMG_1.jpg", "IMG_2.jpg"]
    with Image.open(tmp_path / "work" / "images" / "IMG_1.jpg") as picture:
        assert picture.format == "JPEG" and picture.size == (64, 48)
    monkeypatch.setitem(sys.modules, "pillow_heif", None)
    with pytest.raises(InputError, match=naming(2, "pip install 'pillow-heif")):
        find_photos(source)


def test_a_camera_is_one_size_maker_and_focal_length(tmp_path):
    write_photo(tmp_path / "1.jpg", model="A", focal=4.0)
    write_photo(tmp_path / "2.jpg", model="A", focal=9.0)
    write_photo(tmp_path / "3.jpg", model="A", focal=4.0)
    write_photo(tmp_path / "4.jpg", size=(30, 40), model="A", focal=4.0)
    write_photo(tmp_path / "5.jpg")
    assert group_by_camera(find_photos(tmp_path)) == [["1.jpg", "3.jpg"], ["2.jpg"], ["4.jpg"], ["5.jpg"]]


@pytest.mark.parametrize(("suffix", "form"), [(".jpg", "JPEG"), (".tif", "TIFF")])
def test_rotated_photographs_and_their_masks_are_written_upright(suffix, form, tmp_path):
    source, target = tmp_path / "photos", tmp_path / "work" / "images"
    for i, orientation in enumerate((6, 1, 6)):
        write_turned(source / f"{i}{suffix}", orientation, form)
        mask = np.zeros((30, 40), np.uint8)
        mask[:10] = 255
        Image.fromarray(mask).save(source / f"{i}_mask.png")
    for _ in range(2):
        found = copy_photos(find_photos(source), source, target)
    assert [p.size for p in found] == [(30, 40), (40, 30), (30, 40)]
    assert group_by_camera(found) == [[f"0{suffix}", f"2{suffix}"], [f"1{suffix}"]]
    assert group_by_camera(find_photos(target)) == group_by_camera(found) and len(list(target.iterdir())) == 6
    for name in (f"0{suffix}", "0_mask.png"):
        with Image.open(target / name) as picture:
            red = picture.convert("RGB")
            assert red.getpixel((28, 20))[0] > 200 and red.getpixel((2, 20))[0] < 60
    assert (target / f"1{suffix}").read_bytes() == (source / f"1{suffix}").read_bytes()
    assert [p.orientation for p in check_in_place(find_photos(source), source)] == [6, 1, 6]


def test_copies_have_names_and_formats_that_colmap_reads_and_are_made_once(tmp_path):
    source, target = tmp_path / "my photos", tmp_path / "work" / "images"
    write_photo(source / "#a b" / "IMG (0).jpg").chmod(0o444)
    write_photo(source / "c.webp")
    write_turned(source / "d.JPG", form="MPO" if "MPO" in Image.SAVE else "JPEG")
    (tmp_path / "linked").mkdir()
    write_photo(tmp_path / "linked" / "e.png")
    (source / "link").symlink_to(tmp_path / "linked", target_is_directory=True)
    (source / "self").symlink_to(source, target_is_directory=True)
    found = find_photos(source)
    there = copy_photos(found, source, target)
    assert [p.name for p in there] == ["_a_b/IMG_(0).jpg", "c.jpg", "d.JPG", "link/e.png"]
    assert sorted(p.relative_to(target).as_posix() for p in target.rglob("*.*")) == sorted(p.name for p in there)
    before = {p: p.stat().st_mtime_ns for p in target.rglob("*.*")}
    assert copy_photos(find_photos(source), source, target) == there and before == {p: p.stat().st_mtime_ns for p in target.rglob("*.*")}
    (source / "c.webp").unlink()
    write_photo(source / "link" / "e.png", size=(50, 30))
    assert copy_photos(find_photos(source), source, target)[-1].size == (50, 30) and not (target / "c.jpg").exists()
    with pytest.raises(InputError, match="COLMAP"):
        check_in_place(found, source)
    write_photo(source / "_a b" / "IMG (0).jpg")
    with pytest.raises(InputError, match="IMG"):
        find_photos(source)


def test_a_capture_inside_the_photographs_is_ignored(tmp_path):
    for i in range(3):
        write_photo(tmp_path / f"{i}.jpg")
    write_photo(tmp_path / "out" / "images" / "0.jpg")
    assert len(find_photos(tmp_path, exclude=tmp_path / "out")) == 3 and len(find_photos(tmp_path)) == 4


def test_names_that_are_not_utf8_are_reported(tmp_path):
    for i in range(3):
        write_photo(tmp_path / f"{i}.jpg")
    try:
        (tmp_path / os.fsdecode(b"\xe9.jpg")).write_bytes((tmp_path / "0.jpg").read_bytes())
    except OSError:
        pytest.skip("this file system has names in UTF-8 alone")
    with pytest.raises(InputError, match="UTF-8"):
        find_photos(tmp_path)


def test_grey_images_of_16_bits_are_written_with_8(tmp_path):
    """COLMAP does not read 16 bits, and Pillow's own conversion clips at 255."""
    source, target = tmp_path / "photos", tmp_path / "work" / "images"
    source.mkdir()
    deep = np.linspace(0, 65535, 40 * 30).astype(np.uint16).reshape(30, 40)
    for name in ("a.png", "b.tif", "c.png"):
        Image.fromarray(deep).save(source / name)
    there = copy_photos(find_photos(source), source, target)
    assert [p.name for p in there] == ["a.png", "b.png", "c.png"]
    for one in there:
        with Image.open(target / one.name) as picture:
            assert picture.mode == "L" and np.abs(np.asarray(picture) - deep / 257).max() <= 0.5
    with pytest.raises(InputError, match="COLMAP"):
        check_in_place(find_photos(source), source)


def test_a_changed_mask_is_copied_again(tmp_path):
    source, target = tmp_path / "photos", tmp_path / "work" / "images"
    for i in range(3):
        write_photo(source / f"{i}.jpg")
    for value in (255, 0):
        Image.new("L", (40, 30), value).save(source / "0_mask.png")
        os.utime(source / "0_mask.png", (1, 1 + value))
        copy_photos(find_photos(source), source, target)
        with Image.open(target / "0_mask.png") as mask:
            assert mask.getextrema() == (value, value)


@pytest.mark.parametrize("form", ["EPS", "PCX", "TGA"])
def test_only_known_decoders_see_photographs(tmp_path, form, monkeypatch):
    """Pillow would run Ghostscript for an EPS file that is called a.png."""
    monkeypatch.setattr("subprocess.check_call", lambda *a, **k: pytest.fail("a program was started"))
    for name in "bc":
        write_photo(tmp_path / f"{name}.png")
    Image.new("RGB", (64, 48)).save(tmp_path / "a.png", form)
    with pytest.raises(InputError, match=r"a\.png"):
        find_photos(tmp_path)


def said(folder):
    lines = []
    return find_photos(folder, say=lines.append), "\n".join(lines)


def test_what_else_is_in_the_folder_is_told(tmp_path):
    for i in range(3):
        write_photo(tmp_path / "a" / f"{i}.jpg")
        Image.new("L", (40, 30), 1).save(tmp_path / "a" / f"{i}.jpg.mask.png")
    (tmp_path / "a" / "notes.txt").write_text("no photograph")
    found, lines = said(tmp_path / "a")
    assert [photo.name for photo in found] == ["0.jpg", "1.jpg", "2.jpg"] and all(photo.mask for photo in found)
    assert "3 of 3 photographs have a mask" in lines and "every value but 0 counts" in lines
    assert "ignored 1 file that are no photographs: notes.txt" in lines
    there = copy_photos(found, tmp_path / "a", tmp_path / "out" / "images")
    with Image.open(there[0].mask.path) as mask:
        assert mask.getextrema() == (255, 255)


@pytest.mark.parametrize("place", ["photos/masks", "masks"])
def test_masks_in_a_folder_of_their_own_are_no_photographs(tmp_path, place):
    for name in ("a/0.jpg", "1.jpg", "2.jpg"):
        write_photo(tmp_path / "photos" / name)
        path = (tmp_path / place / name).with_suffix(".png")
        path.parent.mkdir(parents=True, exist_ok=True)
        Image.new("L", (40, 30), 255).save(path)
    found, lines = said(tmp_path / "photos")
    assert [photo.name for photo in found] == ["1.jpg", "2.jpg", "a/0.jpg"] and all(photo.mask for photo in found), lines


def test_all_unreadable_photographs_are_named_at_once(tmp_path):
    for i in range(4):
        write_photo(tmp_path / f"{i}.jpg")
    for i in (1, 3):
        (tmp_path / f"{i}.jpg").write_text("no picture")
    with pytest.raises(InputError, match=r"2 files that cannot be read: 1\.jpg, 3\.jpg"):
        find_photos(tmp_path)
    write_photo(tmp_path / "3.jpg")
    with pytest.raises(InputError, match="content that is no picture of a known format"):
        find_photos(tmp_path)


def test_panoramas_are_found_by_their_data_or_their_shape_and_edges(tmp_path):
    turned = lambda: [photo.name for photo in find_photos(tmp_path) if photo.round]  # noqa: E731
    for i in range(3):
        write_photo(tmp_path / f"{i}.jpg")
    assert not turned()
    Image.new("RGB", (100, 60)).save(tmp_path / "2.jpg", xmp=b'<x GPano:ProjectionType="equirectangular"/>')
    assert turned() == ["2.jpg"]
    panorama = Image.fromarray(draw_panorama(paint_walls(64), (0.2, 0, 0.4), 0.3, 512)).resize((2000, 1000))
    panorama.save(tmp_path / "2.jpg")
    assert turned() == ["2.jpg"]
    panorama.crop((250, 250, 750, 500)).resize((2000, 1000)).save(tmp_path / "2.jpg")
    assert not turned()


def test_photographs_of_one_camera_are_all_panoramas_or_none():
    photos = [Photo(str(i), (20, 10), ("A",), round=i < 2) for i in range(4)] + [Photo("4", (20, 10), ("B",), round=False)]
    assert [photo.round for photo in decide_round(photos)] == [True] * 4 + [False]
    assert not any(photo.round for photo in decide_round([Photo(str(i), (20, 10), round=i < 1) for i in range(3)]))


def test_photographs_that_differ_in_extension_only_have_masks_of_their_own(tmp_path):
    source, target = tmp_path / "photos", tmp_path / "work" / "images"
    for name, level in (("1.jpg", 0), ("1.png", 255), ("2.jpg", 255)):
        write_photo(source / name)
        (source / "masks").mkdir(exist_ok=True)
        Image.new("L", (40, 30), level).save(source / "masks" / f"{name}.png")
    photos = find_photos(source)
    found = copy_photos(photos, source, target)
    there = find_masks({photo.name: target / photo.name for photo in found}, [target]).masks
    assert {name: np.asarray(Image.open(mask.path)).max() for name, mask in there.items()} == {"1.jpg": 0, "1.png": 255, "2.jpg": 255}
    assert there["2.jpg"].path.name == "2_mask.png"
    there["1.jpg"].path.unlink()  # copied again, though the photograph is there
    assert copy_photos(photos, source, target)[0].mask.path.is_file()
