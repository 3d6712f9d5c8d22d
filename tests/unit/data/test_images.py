"""Decoding: sizes, alpha, masks, EXIF, colour depth, undistortion, damaged files."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from scene_experts.core.errors import InputError
from scene_experts.data.images import FrameSource, PhotoHeader, check_policy, decode, probe, target_size
from scene_experts.data.lens import Lens, to_pinhole
from scene_experts.data.masks import Mask
from support.messages import naming
from support.synthetic import look_at, picture


def pinhole(width: int, height: int) -> Lens:
    return Lens("PINHOLE", width, height, (50.0, 50.0, width / 2, height / 2))


def noise(height: int, width: int, channels: int = 3, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, 256, (height, width, channels)).astype(np.uint8)


def source(path: Path, pixels: np.ndarray, **options: object) -> FrameSource:
    Image.fromarray(pixels.squeeze()).save(path)
    h, w = pixels.shape[:2]
    return FrameSource(path, pinhole(w, h), **({"size": (w, h)} | options))  # type: ignore[arg-type]


def test_pixels_are_not_changed(tmp_path: Path) -> None:
    pixels = noise(9, 13)
    rgb, mask = decode(source(tmp_path / "a.png", pixels))
    assert rgb.dtype == torch.uint8 and mask is None
    np.testing.assert_array_equal(rgb, pixels)


def test_grey_and_16_bit_become_rgb(tmp_path: Path) -> None:
    grey = noise(5, 7, 1)
    rgb, _ = decode(source(tmp_path / "g.png", grey))
    np.testing.assert_array_equal(rgb, np.repeat(grey, 3, 2))
    Image.fromarray(grey[..., 0].astype(np.uint16) * 257).save(tmp_path / "d.png")
    rgb, _ = decode(FrameSource(tmp_path / "d.png", pinhole(7, 5), (7, 5)))
    np.testing.assert_array_equal(rgb, np.repeat(grey, 3, 2))


def test_palette_with_transparency_becomes_a_mask(tmp_path: Path) -> None:
    image = Image.new("P", (4, 3), 0)
    image.putpalette([200, 10, 20, 0, 255, 0])
    image.putpixel((1, 1), 1)
    image.save(tmp_path / "p.png", transparency=1)
    rgb, mask = decode(FrameSource(tmp_path / "p.png", pinhole(4, 3), (4, 3)))
    assert rgb[0, 0].tolist() == [200, 10, 20]
    assert mask is not None and mask[1, 1] == 0 and mask.sum() == 255 * 11


def test_resizing_equals_pillows(tmp_path: Path) -> None:
    pixels = noise(40, 60)
    rgb, _ = decode(source(tmp_path / "a.png", pixels, size=(21, 13)))
    np.testing.assert_array_equal(rgb, np.asarray(Image.fromarray(pixels).resize((21, 13), Image.Resampling.BICUBIC)))


def test_alpha_is_a_mask_or_composited_in_float_and_rounded(tmp_path: Path) -> None:
    pixels = noise(8, 6, 4)
    made = source(tmp_path / "a.png", pixels)
    rgb, mask = decode(made)
    np.testing.assert_array_equal(rgb, pixels[..., :3])
    np.testing.assert_array_equal(mask, pixels[..., 3])
    over, mask = decode(source(tmp_path / "a.png", pixels, background=(1.0, 0.5, 0.0)))
    a = pixels[..., 3:].astype(np.float64) / 255
    expected = pixels[..., :3] * a + np.array([255, 127.5, 0]) * (1 - a)
    assert mask is None and np.abs(over.numpy() - expected).max() <= 0.5 + 1e-4


def test_an_image_four_pixels_high_is_not_taken_for_alpha(tmp_path: Path) -> None:  # the reference codes take it for alpha
    _, mask = decode(source(tmp_path / "a.png", noise(4, 6)))
    assert mask is None


def test_mask_files_multiply_with_alpha_and_follow_the_size(tmp_path: Path) -> None:
    pixels = noise(8, 6, 4)
    stencil = np.zeros((8, 6), np.uint8)
    stencil[:, 3:] = 255
    Image.fromarray(stencil).save(tmp_path / "m.png")
    _, mask = decode(source(tmp_path / "a.png", pixels, mask=Mask(tmp_path / "m.png")))
    np.testing.assert_array_equal(mask, np.where(stencil > 0, pixels[..., 3], 0))
    Image.fromarray(stencil).resize((12, 16), 0).save(tmp_path / "m.png")  # a mask at another resolution
    _, mask = decode(source(tmp_path / "b.png", noise(8, 6), mask=Mask(tmp_path / "m.png"), size=(3, 4)))
    assert mask is not None and mask.shape == (4, 3) and mask[:, 0].max() == 0 and mask[:, 2].min() == 255


@pytest.mark.parametrize(("size", "fine"), [((8, 6), True), ((15, 11), True), ((64, 48), True), ((6, 8), False), ((20, 3), False)])
def test_a_mask_of_another_shape_is_refused(tmp_path: Path, size: tuple[int, int], fine: bool) -> None:
    Image.new("L", size).save(tmp_path / "m.png")  # of a rotated or of another photograph: stretched, it would hide what counts
    made = source(tmp_path / "a.png", noise(48, 64), mask=Mask(tmp_path / "m.png"))
    if fine:
        mask = decode(made)[1]
        assert mask is not None and mask.shape == (48, 64)
    else:
        with pytest.raises(InputError, match=naming(tmp_path / "m.png")):
            decode(made)


@pytest.mark.parametrize("name", ["a.png", "a.tif"])
def test_exif_is_applied_only_on_request(name: str, tmp_path: Path) -> None:
    pixels = noise(10, 16)
    exif = Image.Exif()
    exif[0x0112] = 6
    Image.fromarray(pixels).save(tmp_path / name, exif=exif)
    assert probe(tmp_path / name) == PhotoHeader((16, 10), 6) and PhotoHeader((16, 10), 6).turned == (10, 16)
    rgb, _ = decode(FrameSource(tmp_path / name, pinhole(16, 10), (16, 10)))
    np.testing.assert_array_equal(rgb, pixels)
    rgb, _ = decode(FrameSource(tmp_path / name, pinhole(10, 16), (10, 16), turn=True))
    np.testing.assert_array_equal(rgb, np.rot90(pixels, -1))
    stencil = np.zeros((10, 16), np.uint8)
    stencil[:3] = 255
    for mask in (stencil, np.ascontiguousarray(np.rot90(stencil, -1))):  # a mask of the stored pixels, or of the rotated ones
        Image.fromarray(mask).save(tmp_path / "m.png")
        found = decode(FrameSource(tmp_path / name, pinhole(10, 16), (10, 16), mask=Mask(tmp_path / "m.png"), turn=True))[1]
        np.testing.assert_array_equal(found, np.rot90(stencil, -1))


@pytest.mark.parametrize(
    "lens",
    [
        Lens("OPENCV", 120, 90, (100.0, 101.0, 66.0, 41.0, -0.15, 0.03, 0.002, -0.001)),
        Lens("RADIAL_FISHEYE", 120, 90, (80.0, 66.0, 41.0, 0.02, -0.01)),
        Lens("FOV", 120, 90, (100.0, 101.0, 66.0, 41.0, 0.6)),
    ],
    ids=lambda lens: lens.model,
)
def test_undistorted_photograph_is_the_pinhole_picture(tmp_path: Path, lens: Lens) -> None:
    pose = look_at(np.array([2.6, 1.9, 2.2]), np.array([0.0, 0.0, 0.2]))
    Image.fromarray(np.rint(255 * picture(lens, pose, 1.0, (0, 0, 0))).astype(np.uint8)).save(tmp_path / "a.png")
    flat = to_pinhole(lens)
    rgb, _ = decode(FrameSource(tmp_path / "a.png", lens, (flat.width, flat.height)))
    truth = picture(flat, pose, 1.0, (0, 0, 0))
    error = np.abs(rgb.numpy() / 255 - truth)
    assert np.median(error) < 0.004 and error.mean() < 0.02  # the second sampling slightly blurs the edges of objects


def test_rays_beyond_the_fold_of_a_lens_do_not_count(tmp_path: Path) -> None:
    lens = Lens("SIMPLE_RADIAL", 192, 108, (87.0, 96.0, 54.0, -0.15))  # rays beyond radius 1.49 fall back into the photograph
    Image.fromarray(noise(108, 192)).save(tmp_path / "a.png")
    flat = to_pinhole(lens)
    _, mask = decode(FrameSource(tmp_path / "a.png", lens, (flat.width, flat.height)))
    y, x = np.mgrid[: flat.height, : flat.width] + 0.5
    radius = np.hypot((x - flat.cx) / flat.fx, (y - flat.cy) / flat.fy)
    assert mask is not None
    np.testing.assert_array_equal(mask, np.where(radius > 1 / np.sqrt(3 * 0.15), 0, 255))


def test_policies() -> None:
    assert check_policy("auto") == "cap1600"
    assert target_size("as-is", (4946, 3286)) == (4946, 3286)
    assert target_size("cap1600", (1600, 1200)) == (1600, 1200)
    assert target_size("cap1600", (3200, 2133)) == (1600, 1066)
    assert target_size("cap1600", (1000, 9000)) == (1000, 9000)  # the cap is on the width
    assert target_size("factor:4", (4946, 3286)) == (1236, 822)
    assert target_size("factor:2", (4946, 3287)) == (2473, 1644)
    assert target_size("longest:800", (1000, 1600)) == (500, 800)
    assert target_size("longest:800", (300, 200)) == (300, 200)
    assert target_size("inria:4", (1237, 822)) == (1237, 822)


@pytest.mark.parametrize("policy", ["big", "factor:0", "factor:x", "longest:", "inria:1.5", "factor:nan"])
def test_bad_policies(policy: str) -> None:
    with pytest.raises(InputError, match="--resolution"):
        check_policy(policy)


def test_bad_files(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"none\.png"):
        probe(tmp_path / "none.png")
    (tmp_path / "text.png").write_text("hello")
    with pytest.raises(InputError, match=r"text\.png"):
        probe(tmp_path / "text.png")
    (tmp_path / "empty.jpg").write_bytes(b"")
    with pytest.raises(InputError, match=r"empty\.jpg"):
        probe(tmp_path / "empty.jpg")
    for ending in ("png", "jpg"):
        made = source(tmp_path / f"cut.{ending}", noise(64, 64))
        whole = made.path.read_bytes()
        made.path.write_bytes(whole[: len(whole) // 2])
        with pytest.raises(InputError, match=f"cut.{ending}"):
            decode(made)
    made = source(tmp_path / "grown.png", noise(8, 8))
    Image.fromarray(noise(8, 9)).save(made.path)
    with pytest.raises(InputError, match=naming("8x8", "9x8")):
        decode(made)
