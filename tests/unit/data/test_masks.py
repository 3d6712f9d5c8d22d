"""Masks: where they are found, and what their values mean."""

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from scene_experts.data.masks import Mask, find_masks, may_be_mask, read_mask, to_levels


def write(path: Path, values: object = 255, mode: str | None = None) -> Path:
    """Write a picture of 8 x 6 px: 2 rows of 0 above rows of `values`."""
    path.parent.mkdir(parents=True, exist_ok=True)
    pixels = np.full((6, 8), values)
    pixels[:2] = 0
    picture = Image.fromarray(pixels.astype(np.uint8) if mode is None else pixels.astype(mode))
    picture.save(path)
    return path


def photographs(root: Path, *names: str) -> dict[str, Path]:
    for name in names:
        Image.new("RGB", (8, 6), (90, 120, 40)).save(write(root / "images" / name))
    return {name: root / "images" / name for name in names}


PLACES = [
    "masks/s/a.jpg", "masks/s/a.jpg.png", "masks/s/a.png", "images/s/a.mask.png", "images/s/a_mask.png", "images/s/a.jpg.mask.png",
    "masks/s/a.jpg.mask.png", "masks/s/a.tif", "masks/s/a_mask.png", "mask/s/a.png", "masks/a.png", "images/s/mask_a.png",
    "images/s/a-mask.PNG", "images/s/a.jpg_mask.png", "images/s/a.jpg.png", "images/masks/s/a.png", "images/s/masks/a.png",
    "masks/images/s/a.png",
]  # fmt: skip


@pytest.mark.parametrize("place", PLACES)
def test_masks_are_found_under_every_name(tmp_path: Path, place: str) -> None:
    photos = photographs(tmp_path, "s/a.jpg", "b.jpg")
    folders = [tmp_path, tmp_path / "images"]
    assert not find_masks(photos, folders).masks
    write(tmp_path / place)
    found = find_masks(photos, folders)
    assert found.masks == {"s/a.jpg": Mask(tmp_path / place)} and found.files == {tmp_path / place}
    assert found.warnings == ("1 of 2 photographs have no mask and count fully (first: b.jpg)",)
    assert may_be_mask(Path(place).relative_to(Path(place).parts[0]).as_posix()) or place.startswith("mask")


def test_a_dynamic_mask_is_white_where_pixels_do_not_count(tmp_path: Path) -> None:
    photos = photographs(tmp_path, "a.jpg")
    write(tmp_path / "images/dynamic_mask_a.png")
    mask = find_masks(photos, [tmp_path]).masks["a.jpg"]
    assert mask.inverted and np.asarray(read_mask(mask))[:, 0].tolist() == [255, 255, 0, 0, 0, 0]


def test_a_file_belongs_to_the_photograph_in_its_own_folder(tmp_path: Path) -> None:
    photos = photographs(tmp_path, "a.jpg", "s/a.jpg", "t/b.jpg", "u/b.jpg", "c.jpg", "c.png", "mask_d.jpg")
    for name in ("a.png", "s/a.png", "b.png", "c.png", "mask_d.png"):
        write(tmp_path / "masks" / name)
    found = find_masks(photos, [tmp_path])
    expected = {"a.jpg": "a", "s/a.jpg": "s/a", "c.png": "c", "mask_d.jpg": "mask_d"}
    assert {name: mask.path for name, mask in found.masks.items()} == {n: tmp_path / f"masks/{m}.png" for n, m in expected.items()}
    assert "1 files that match no photograph (first: b.png)" in found.warnings[0]  # of t or of u?


def test_files_that_match_nothing_are_told_unless_their_photograph_has_no_pose(tmp_path: Path) -> None:
    photos = photographs(tmp_path, "a.jpg", "b.jpg", "unposed.jpg")
    del photos["unposed.jpg"]
    for name in ("a", "b", "unposed"):
        write(tmp_path / f"masks/{name}.png")
    assert find_masks(photos, [tmp_path]).warnings == ()
    write(tmp_path / "masks/zebra.png")
    (told,) = find_masks(photos, [tmp_path]).warnings
    assert "masks/ holds 1 files" in told and "zebra.png" in told and "masks/a.jpg.png" in told
    write(tmp_path / "elsewhere/masks/other.png")
    assert find_masks(photos, [], maybe=[tmp_path / "elsewhere"]).warnings == ()


def test_two_masks_of_one_photograph_are_told_and_a_stated_one_comes_first(tmp_path: Path) -> None:
    photos = photographs(tmp_path, "a.jpg")
    first, second, stated = (write(tmp_path / name) for name in ("masks/a.png", "images/a_mask.png", "stencils/1.png"))
    found = find_masks(photos, [tmp_path])
    assert found.masks["a.jpg"].path == first and "images/a_mask.png" in found.warnings[0] and found.files == {first, second}
    found = find_masks(photos, [tmp_path], stated={"a.jpg": stated})
    assert found.masks["a.jpg"].path == stated and not found.warnings


def weights(tmp_path: Path, *files: Path) -> tuple[list[int], tuple[str, ...]]:
    """Return the middle column of the first mask as it is read, and the warnings."""
    photos = photographs(tmp_path, *(f"{path.stem}.jpg" for path in files))
    found = find_masks(photos, [tmp_path])
    return np.asarray(read_mask(found.masks[f"{files[0].stem}.jpg"]))[:, 4].tolist(), found.warnings


@pytest.mark.parametrize("value", [1, 2, 100, 200])
def test_every_value_but_0_counts_where_none_is_white(tmp_path: Path, value: int) -> None:
    column, told = weights(tmp_path, write(tmp_path / "masks/a.png", value))
    assert column == [0, 0, 255, 255, 255, 255] and "every value but 0 counts" in told[0]


@pytest.mark.parametrize(
    ("value", "mode"), [(1, "uint16"), (255, "uint16"), (65535, "uint16"), (7, "int32"), (1.0, "float32"), (255.0, "float32")]
)
def test_deep_masks(tmp_path: Path, value: float, mode: str) -> None:
    assert weights(tmp_path, write(tmp_path / "masks/a.tif", value, mode))[0] == [0, 0, 255, 255, 255, 255]


def test_one_rule_holds_for_all_masks_of_a_capture(tmp_path: Path) -> None:
    """A mask without white among masks with white is a dark one, not one of labels."""
    dark, white = write(tmp_path / "masks/a.png", 51), write(tmp_path / "masks/b.png")
    assert weights(tmp_path, dark, white) == ([0, 0, 51, 51, 51, 51], ())


def test_a_grey_ramp_is_a_weight(tmp_path: Path) -> None:
    ramp = 240 - 5 * np.arange(48).reshape(6, 8)
    column, told = weights(tmp_path, write(tmp_path / "masks/a.png", ramp))
    assert column == [0, 0, *ramp[2:, 4]] and "brightness is the weight" in told[0]
    ramp[2:, 0], ramp[2:, 1:] = 255, 60
    assert weights(tmp_path, write(tmp_path / "masks/a.png", ramp))[1][0].startswith("88% of the pixels")


def test_palette_masks_are_labels_unless_their_colours_are_grey(tmp_path: Path) -> None:
    index = np.ones((6, 8), np.uint8)
    index[:2] = 0
    path = tmp_path / "masks/a.png"
    path.parent.mkdir()
    for palette, expected in (
        ([0, 0, 0, 128, 0, 0], [0, 255]), ([68, 1, 84, 253, 231, 37], [0, 255]), ([255, 255, 255, 0, 0, 0], [255, 0]), ([0] * 6, [0, 255])
    ):  # fmt: skip
        picture = Image.fromarray(index, "P")
        picture.putpalette(palette)
        picture.save(path)
        assert weights(tmp_path, path)[0] == [expected[0]] * 2 + [expected[1]] * 4, palette


def test_colours_count_and_black_with_alpha_is_alpha(tmp_path: Path) -> None:
    pixels = np.zeros((6, 8, 4), np.uint8)
    pixels[2:, :, 3] = 255
    assert np.asarray(to_levels(Image.fromarray(pixels)))[:, 0].tolist() == [0, 0, 255, 255, 255, 255]
    blue = np.zeros((6, 8, 3), np.uint8)
    blue[2:, :, 2] = 1  # its brightness is rounded to 0
    path = tmp_path / "masks/a.png"
    path.parent.mkdir()
    Image.fromarray(blue).save(path)
    assert weights(tmp_path, path)[0] == [0, 0, 255, 255, 255, 255]


def test_masks_that_leave_nearly_nothing_are_told(tmp_path: Path) -> None:
    almost = np.zeros((6, 8))
    almost[3, 3] = 255
    assert "only 2.1% of the pixels count" in weights(tmp_path, write(tmp_path / "masks/a.png", almost))[1][0]
    assert "no pixel counts" in weights(tmp_path, write(tmp_path / "masks/a.png", 0))[1][0]
