"""All bits of colours of 16 bits."""

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from scene_experts.core.reading.deep_colors import describe_mode, read_deep_colors
from scene_experts.data.colour import White, lift
from support.deep import write_png16, write_tiff16


@pytest.mark.parametrize("form", ["png", "<", ">"])
def test_all_bits_are_read(tmp_path: Path, form: str) -> None:
    values = np.random.default_rng(0).integers(0, 65536, (5, 7, 3))
    write_png16(tmp_path / "a", values, 2) if form == "png" else write_tiff16(tmp_path / "a", values, form)
    with Image.open(tmp_path / "a") as image:
        assert describe_mode(image) == "RGB;16" and np.array_equal(read_deep_colors(image), values)


def test_others_have_the_mode_of_pillow(tmp_path: Path) -> None:
    for mode in ("RGB", "RGBA", "L", "I;16"):
        Image.new(mode, (3, 2)).save(tmp_path / "a.png")
        with Image.open(tmp_path / "a.png") as image:
            assert describe_mode(image) == mode


def test_a_part_of_the_range_is_lifted_and_the_whole_range_left_to_pillow(tmp_path: Path) -> None:
    values = np.random.default_rng(0).integers(0, 4096, (5, 7, 3))
    write_png16(tmp_path / "a.png", values, 2)
    with Image.open(tmp_path / "a.png") as image:
        assert np.array_equal(np.asarray(lift(image, White(color=4095.0))), np.rint(values * (255 / 4095)))
    with Image.open(tmp_path / "a.png") as image:
        assert lift(image, White()) is image
