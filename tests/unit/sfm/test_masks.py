"""Masks in COLMAP's format: no features are extracted where a mask is black."""

import numpy as np
import pytest
from PIL import Image

from scene_experts.core.errors import InputError
from scene_experts.sfm.masks import write_masks
from scene_experts.sfm.photos import check_in_place, copy_photos, find_photos
from support.photos import write_photo, write_turned


def half(size=(40, 30), value=255):
    """Return a mask whose upper half counts."""
    out = np.zeros((size[1], size[0]), np.uint8)
    out[: size[1] // 2] = value
    return Image.fromarray(out)


def test_the_mask_is_found_where_training_finds_it(tmp_path):
    images = tmp_path / "images"
    for name in ("a.jpg", "b.jpg", "c.jpg", "sub/d.jpg"):
        write_photo(images / name)
    half().save(images / "a_mask.png")
    (tmp_path / "masks" / "sub").mkdir(parents=True)
    half((20, 15), value=200).save(tmp_path / "masks" / "b.jpg.png")  # another size, and not quite white
    half().save(tmp_path / "masks" / "sub" / "d.png")
    found = check_in_place(find_photos(images), images)
    marks = write_masks(found, images, tmp_path / "out")
    assert sorted(p.relative_to(tmp_path / "out").as_posix() for p in (tmp_path / "out").rglob("*.png")) == [
        "a.jpg.png", "b.jpg.png", "c.jpg.png", "sub/d.jpg.png"
    ]  # fmt: skip
    for name in ("a.jpg.png", "b.jpg.png", "sub/d.jpg.png"):
        with Image.open(tmp_path / "out" / name) as mask:
            values = np.asarray(mask)
        assert values.shape == (30, 40) and (values[:14] == 255).all() and (values[16:] == 0).all()
    with Image.open(tmp_path / "out" / "c.jpg.png") as mask:  # no mask of its own: COLMAP would skip the photograph
        assert mask.size == (40, 30) and mask.getextrema() == (255, 255)
    assert len(marks) == 4 and write_masks(found, images, tmp_path / "out") == marks
    half(value=0).save(images / "a_mask.png")
    assert write_masks(found, images, tmp_path / "out") != marks
    (images / "a_mask.png").write_bytes(b"no picture")
    with pytest.raises(InputError, match=r"a_mask\.png"):
        write_masks(found, images, tmp_path / "out")


def test_alpha_is_a_mask(tmp_path):
    images = tmp_path / "images"
    for i in range(3):
        write_photo(images / f"{i}.png")
    picture = Image.new("RGBA", (40, 30), (9, 9, 9, 255))
    picture.putalpha(half())
    picture.save(images / "1.png")
    assert len(write_masks(find_photos(images), images, tmp_path / "out")) == 3
    with Image.open(tmp_path / "out" / "1.png.png") as mask:
        assert np.array_equal(np.asarray(mask), np.asarray(half()))


@pytest.mark.parametrize("orientation", [1, 3, 5, 6, 7, 8])
def test_a_mask_has_the_orientation_of_the_stored_photograph(tmp_path, orientation):
    """The mask of a photograph that EXIF rotates may be stored upright or not. COLMAP reads it in the orientation of the stored pixels."""
    source, images = tmp_path / "photos", tmp_path / "images"
    for folder in (source, images):
        for name in ("a", "b", "c"):
            write_turned(folder / f"{name}.jpg", orientation)
        half().save(folder / "a_mask.png")
    with Image.open(copy_of(source / "a_mask.png", orientation)) as upright:
        upright.save(images / "b_mask.png")
    write_masks(check_in_place(find_photos(images), images), images, tmp_path / "stored")
    a, b = (np.asarray(Image.open(tmp_path / "stored" / f"{name}.jpg.png")) for name in "ab")
    assert np.array_equal(a, np.asarray(half())) and (orientation == 3 or np.array_equal(a, b))
    there = copy_photos(find_photos(source), source, tmp_path / "work" / "images")
    write_masks(there, tmp_path / "work" / "images", tmp_path / "upright")
    with Image.open(tmp_path / "upright" / "a.jpg.png") as mask, Image.open(images / "b_mask.png") as upright:
        assert np.array_equal(np.asarray(mask), np.asarray(upright))


def copy_of(path, orientation):
    """Write the mask at `path` upright and return its new path."""
    from scene_experts.sfm.photos import transfer

    transfer(path, path.with_name("upright.bmp"), orientation, suffix=".png")
    return path.with_name("upright.bmp")


def test_without_masks_none_are_written(tmp_path):
    for i in range(3):
        write_photo(tmp_path / "images" / f"{i}.jpg")
    assert write_masks(find_photos(tmp_path / "images"), tmp_path / "images", tmp_path / "out") == [] and not (tmp_path / "out").exists()
