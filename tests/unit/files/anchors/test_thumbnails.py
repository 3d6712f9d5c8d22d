"""Small photographs of a page: their order, size and bytes."""

import io
from types import SimpleNamespace

import pytest
import torch
from PIL import Image

from scene_experts.core.errors import InputError
from scene_experts.files.anchors.thumbnails import SIDES, make_thumbnails
from support.messages import naming


def capture_of(count, width=600, height=400, noise=0):
    """A capture whose photographs have grey levels by their number, and noise."""
    g = torch.Generator().manual_seed(0)

    def frame(index):
        rgb = torch.full((height, width, 3), 20 * index + 10) + torch.randint(0, noise + 1, (height, width, 3), generator=g)
        return SimpleNamespace(rgb=rgb.to(torch.uint8))

    return SimpleNamespace(views=[None] * count, images=range(count), frame=frame)


def test_pictures_are_webp_in_the_order_of_the_views():
    found = [Image.open(io.BytesIO(picture)) for picture in make_thumbnails(capture_of(3))]
    assert [image.format for image in found] == ["WEBP"] * 3 and {image.size for image in found} == {(320, 213)}
    assert [round(image.convert("L").resize((1, 1)).getpixel((0, 0)), -1) for image in found] == [10, 30, 50]


def test_pictures_become_smaller_and_then_fewer_to_fit():
    large = sum(map(len, make_thumbnails(capture_of(4, noise=60), 10**9)))
    found = make_thumbnails(capture_of(4, noise=60), large // 3)
    sides = {Image.open(io.BytesIO(picture)).width for picture in found}
    assert sum(map(len, found)) <= large // 3 and sides <= set(SIDES[1:]) and len(sides) == 1
    most = 2 * max(map(len, make_thumbnails(capture_of(4, noise=60), large // 3))) // 8
    few = make_thumbnails(capture_of(4, noise=60), most)
    assert len(few) == 4 and 0 < sum(map(len, few)) <= most and b"" in few
    assert make_thumbnails(capture_of(4), 1) == [b""] * 4


@pytest.mark.parametrize("count", [0, 2])
def test_without_photographs_there_is_a_sentence(count):
    capture = capture_of(count)
    capture.images = ()
    with pytest.raises(InputError, match=naming("--photographs", "--data")):
        make_thumbnails(capture)
