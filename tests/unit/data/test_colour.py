"""Values of photographs: deep and floating-point ones, colour profiles, nearly black pictures."""

import struct
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image, ImageCms

from scene_experts.core.errors import InputError
from scene_experts.data.colour import White, find_white, to_8_bit, to_srgb
from scene_experts.data.readers.colmap_model import read_model, write_model
from support.captures import load
from support.deep import write_png16, write_tiff16
from support.synthetic import Synthetic, make_capture


@pytest.fixture
def made(tmp_path: Path) -> Synthetic:
    return make_capture(tmp_path / "made", views=9, size=(48, 32), points=300, mixed_sizes=False)


def rewrite(made: Synthetic, factor: float, dtype: str) -> list[np.ndarray]:
    """Store each photograph as grey values times `factor` in a TIFF. Returns the grey values of
    8 bits."""
    grey = []
    for name, rgb in sorted(made.images.items()):
        values = np.asarray(Image.fromarray(rgb).convert("L")).astype(np.float64)
        (made.folder / "images" / name).unlink()
        Image.fromarray((values * factor).astype(dtype)).save((made.folder / "images" / name).with_suffix(".tif"))
        grey.append(values)
    return grey


@pytest.mark.parametrize(
    ("factor", "dtype", "told"),
    [(1 / 255, "float32", ""), (1, "float32", ""), (257, "float32", ""), (257, "uint16", ""),
     (4095 / 255, "uint16", "4,095 is read as white"), (1, "uint16", "255 is read as white"), (1, "int32", "255 is read as white")],
)  # fmt: skip
def test_deep_photographs_of_every_scale(made: Synthetic, factor: float, dtype: str, told: str) -> None:
    grey = rewrite(made, factor, dtype)
    capture = load(made.folder)
    for i, values in enumerate(grey):
        assert np.abs(capture.frame(i).rgb.numpy()[..., 0] - values).max() <= 1
    assert (told in str(capture.warnings)) and ("white" in str(capture.warnings)) == bool(told)


def test_one_white_holds_for_all_photographs(made: Synthetic) -> None:
    """The darkest alone would be taken for one in [0, 1]."""
    grey = rewrite(made, 1, "float32")
    path = sorted((made.folder / "images").iterdir())[3]
    Image.fromarray(np.full((32, 48), 1.0, np.float32)).save(path)
    assert np.asarray(load(made.folder).frame(3).rgb).max() == 1 and len(grey) == 9


def test_floats_of_unknown_scale_are_refused(made: Synthetic) -> None:
    rewrite(made, 20 / 255, "float32")
    with pytest.raises(InputError, match=r"floats up to 1, 255 or 65535 .*view_000\.tif, found 1"):
        load(made.folder)


def test_nearly_black_photographs_are_told(made: Synthetic) -> None:
    assert "black" not in str(load(made.folder).warnings)
    path = made.folder / "images" / "view_000.png"
    Image.fromarray(made.images["view_000.png"] // 64).save(path)
    assert "1 of the 3 photographs looked at are nearly black: view_000.png" in str(load(made.folder).warnings)


D50_FROM_P3 = [[0.515102, 0.291965, 0.157153], [0.241182, 0.692236, 0.066582], [-0.001050, 0.041882, 0.784378]]
D50_FROM_SRGB = [[0.436075, 0.385065, 0.143080], [0.222504, 0.716879, 0.060617], [0.013932, 0.097105, 0.714173]]


def wide_profile() -> bytes:
    """Return an ICC profile (version 2, matrix and gamma 2) with the primaries of Display P3."""

    def xyz(values: list[float]) -> bytes:
        return b"XYZ \0\0\0\0" + b"".join(struct.pack(">i", round(value * 65536)) for value in values)

    columns = list(map(list, zip(*D50_FROM_P3)))
    curve = b"curv\0\0\0\0" + struct.pack(">IHH", 1, 2 << 8, 0)
    tags = {
        "wtpt": xyz([0.9642, 1.0, 0.8249]),
        **{f"{c}XYZ": xyz(column) for c, column in zip("rgb", columns)},
        **{f"{c}TRC": curve for c in "rgb"},
    }
    tags["desc"] = b"desc\0\0\0\0" + struct.pack(">I", 5) + b"wide\0" + bytes(82)
    tags["cprt"] = b"text\0\0\0\0none"
    place, table, body = 128 + 4 + 12 * len(tags), b"", b""
    for name, data in tags.items():
        table += name.encode() + struct.pack(">II", place + len(body), len(data))
        body += data + bytes(-len(data) % 4)
    head = (
        struct.pack(">I", place + len(body))
        + b"lcms\2\x10\0\0mntrRGB XYZ "
        + bytes(12)
        + b"acsp"
        + bytes(28)
        + xyz([0.9642, 1.0, 0.8249])[8:]
    )
    return head + bytes(128 - len(head)) + struct.pack(">I", len(tags)) + table + body


def to_srgb_by_formula(pixels: np.ndarray) -> np.ndarray:
    linear = (pixels / 255.0) ** 2 @ np.array(D50_FROM_P3).T @ np.linalg.inv(D50_FROM_SRGB).T
    linear = linear.clip(0, 1)
    return 255 * np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)


def test_a_profile_is_honoured_and_that_of_srgb_changes_nothing(tmp_path: Path) -> None:
    pixels = np.full((4, 4, 3), (120, 60, 30), np.uint8)
    srgb = ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB")).tobytes()
    for profile, same in ((srgb, True), (wide_profile(), False), (b"no profile", True)):
        Image.fromarray(pixels).save(tmp_path / "a.png", icc_profile=profile)
        with Image.open(tmp_path / "a.png") as image:
            expected = pixels if same else to_srgb_by_formula(pixels)
            assert np.abs(np.asarray(to_8_bit(image)) - expected).max() <= (0 if same else 1.5)
            assert to_srgb(image.convert("L")).mode == "L"
    rgba = np.dstack((pixels, np.full((4, 4), 77, np.uint8)))
    Image.fromarray(rgba).save(tmp_path / "a.png", icc_profile=wide_profile())
    with Image.open(tmp_path / "a.png") as image:
        out = np.asarray(to_8_bit(image))
    assert (out[..., 3] == 77).all() and np.abs(out[..., :3] - to_srgb_by_formula(pixels)).max() <= 1.5


def test_a_photograph_alone_is_read_by_its_own_values() -> None:
    assert np.asarray(to_8_bit(Image.fromarray(np.array([[0, 0.5, 1.0]], np.float32))))[0].tolist() == [0, 128, 255]
    assert np.asarray(to_8_bit(Image.fromarray(np.array([[0, 128, 255]], np.float32))))[0].tolist() == [0, 128, 255]
    assert find_white([]) == (White(), [])


def test_exr_photographs_are_linear_light(made: Synthetic) -> None:
    OpenEXR = pytest.importorskip("OpenEXR")
    for name, rgb in sorted(made.images.items()):
        value = rgb / 255.0
        light = np.where(value <= 0.04045, value / 12.92, ((value + 0.055) / 1.055) ** 2.4).astype(np.float32)
        light[0, 0] = 7.0  # brighter than white
        (made.folder / "images" / name).unlink()
        pixels = {"RGB": light} if name != "view_001.png" else {"RGBA": np.dstack((light, np.full(light.shape[:2], 0.5, np.float32)))}
        OpenEXR.File({}, pixels).write(str((made.folder / "images" / name).with_suffix(".exr")))
    capture = load(made.folder)
    assert "9 EXR photographs are read as linear light" in str(capture.warnings)
    for i, (_, rgb) in enumerate(sorted(made.images.items())):
        found = capture.frame(i)
        rgb[0, 0] = 255
        assert np.abs(found.rgb.numpy().astype(int) - rgb).max() <= 1
        assert (found.mask is None) == (i != 1) and (found.mask is None or abs(float(found.mask.mean()) - 0.5) < 0.01)


def test_exr_photographs_that_cannot_be_read(made: Synthetic, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("OpenEXR")
    path = made.folder / "images/view_000.exr"
    (made.folder / "images/view_000.png").unlink()
    path.write_bytes(b"v/1\x01" + bytes(40))
    with pytest.raises(InputError, match=r"view_000\.exr"):
        load(made.folder)
    monkeypatch.setitem(sys.modules, "OpenEXR", None)
    with pytest.raises(InputError, match=r"package OpenEXR .*pip install .OpenEXR"):
        load(made.folder)
    path.rename(made.folder / "images/view_000.hdr")
    model = read_model(made.folder / "sparse/0")
    images = tuple(replace(image, name=image.name.replace("000.png", "000.hdr")) for image in model.images)
    write_model(made.folder / "sparse/0", replace(model, images=images))
    with pytest.raises(InputError, match=r"view_000\.hdr, found content that is no picture of a known format"):
        load(made.folder)


@pytest.mark.parametrize("form", ["png", "png with alpha", "tiff <", "tiff >"])
@pytest.mark.parametrize(("most", "told"), [(65535, ""), (4095, "4,095 is read as white"), (1023, "1,023 is read as white")])
def test_colours_of_16_bits_that_fill_a_part_of_their_range(made: Synthetic, form: str, most: int, told: str) -> None:
    for name, rgb in made.images.items():
        path = made.folder / "images" / name
        path.unlink()
        values = np.rint(rgb.astype(np.float64) * most / 255)
        if form == "png with alpha":
            values = np.concatenate([values, np.full((*values.shape[:2], 1), most)], 2)
        if form.startswith("png"):
            write_png16(path.with_suffix(".png"), values, 6 if "alpha" in form else 2)
        else:
            write_tiff16(path.with_suffix(".tif"), values, form[-1])
    capture = load(made.folder)
    for i, (_, rgb) in enumerate(sorted(made.images.items())):
        frame = capture.frame(i)
        assert np.abs(frame.rgb.numpy().astype(int) - rgb).max() <= 1 and frame.mask is None
    assert (told in str(capture.warnings)) and ("16-bit colours" in str(capture.warnings)) == bool(told)


@pytest.mark.parametrize(("mode", "clear"), [("RGB", (255, 0, 255)), ("L", 7)])
def test_a_transparent_colour_is_transparent(mode: str, clear: object, tmp_path: Path) -> None:
    picture = Image.new(mode, (2, 1), clear)
    picture.putpixel((1, 0), 9 if mode == "L" else (1, 2, 3))
    picture.save(tmp_path / "x.png", transparency=clear)
    with Image.open(tmp_path / "x.png") as found:
        assert np.asarray(to_8_bit(found))[0, :, 3].tolist() == [0, 255]
