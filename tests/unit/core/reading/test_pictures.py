"""Pictures: limits on their pixels, their formats and their files."""

import io

import numpy as np
import pytest
from PIL import Image, ImageOps

from scene_experts.core.errors import InputError
from scene_experts.core.reading.budget import PICTURE, Damaged
from scene_experts.core.reading.pictures import decode_picture, opening_picture
from support.messages import naming


def test_a_picture(tmp_path):
    Image.new("RGB", (3, 2), (1, 2, 3)).save(tmp_path / "a.png")
    with opening_picture(tmp_path / "a.png", PICTURE) as image:
        assert image.size == (3, 2) and image.convert("RGB").getpixel((0, 0)) == (1, 2, 3)


@pytest.mark.parametrize("orientation", range(2, 9))
@pytest.mark.parametrize("name", ["a.png", "a.tif", "packed.tif"])
def test_pixels_are_as_stored_whatever_the_orientation(name, orientation, tmp_path):
    """Pillow turns the pixels of TIFF files on its own, and forgets their orientation."""
    pixels = np.arange(4 * 6 * 3, dtype=np.uint8).reshape(4, 6, 3)
    exif = Image.Exif()
    exif[0x0112], exif[0x010F] = orientation, "maker"
    Image.fromarray(pixels).save(tmp_path / name, exif=exif, **({"compression": "tiff_lzw"} if name == "packed.tif" else {}))
    with opening_picture(tmp_path / name, PICTURE) as image:
        assert image.size == (6, 4) and image.getexif()[0x0112] == orientation and image.getexif()[0x010F] == "maker"
        assert np.array_equal(np.asarray(image), pixels)
        upright = ImageOps.exif_transpose(image)
        assert upright.size == ((4, 6) if orientation >= 5 else (6, 4)) and 0x0112 not in upright.getexif()


def test_pictures_that_are_refused(tmp_path):
    Image.new("L", (8000, 8000)).save(tmp_path / "bomb.png")
    Image.new("L", (4, 4)).save(tmp_path / "other.ico")
    (tmp_path / "text.png").write_text("no picture")
    whole = io.BytesIO()
    Image.effect_noise((64, 64), 90).save(whole, "PNG")
    (tmp_path / "cut.png").write_bytes(whole.getvalue()[:-500])
    for name in ("bomb.png", "other.ico", "text.png", "cut.png", "absent.png"):
        with pytest.raises(InputError, match=naming(name)), opening_picture(tmp_path / name, PICTURE) as image:
            image.load()


def test_pictures_inside_other_files():
    stream = io.BytesIO()
    Image.new("RGB", (10, 10)).save(stream, "PNG")
    assert decode_picture(stream.getvalue(), 100, "PNG").size == (10, 10)
    with pytest.raises(Damaged, match="10 x 10"):
        decode_picture(stream.getvalue(), 99, "PNG")
    with pytest.raises(OSError):
        decode_picture(stream.getvalue(), 100, "WEBP")
