"""Pictures: limits on their pixels, their formats and their files."""

import io

import pytest
from PIL import Image

from scene_experts.core.errors import InputError
from scene_experts.core.reading.budget import PICTURE, Damaged
from scene_experts.core.reading.pictures import decode_picture, opening_picture
from support.messages import naming


def test_a_picture(tmp_path):
    Image.new("RGB", (3, 2), (1, 2, 3)).save(tmp_path / "a.png")
    with opening_picture(tmp_path / "a.png", PICTURE) as image:
        assert image.size == (3, 2) and image.convert("RGB").getpixel((0, 0)) == (1, 2, 3)


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
