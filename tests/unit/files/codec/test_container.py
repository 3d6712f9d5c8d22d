"""The bytes around the parts: they come back, and others are told apart."""

import zlib

import pytest

from scene_experts.core.reading.budget import CutShort, Damaged
from scene_experts.files.codec import container

PARTS = {"a": b"12", "b": b"", "c": b"345"}


def test_header_and_parts_come_back():
    data = container.join({"N": 3, "list": [1.5]}, PARTS)
    assert data.startswith(b"SXCOMP2\n") and container.part(data) == ({"N": 3, "list": [1.5]}, PARTS)


@pytest.mark.parametrize("cut", [9, 12, 20, -5, -1])
def test_lost_bytes(cut):
    with pytest.raises(CutShort):
        container.part(container.join({}, PARTS)[:cut])


def sealed(data):
    return data + zlib.crc32(data).to_bytes(4, "little")


def test_headers_that_do_not_fit():
    data = container.join({}, PARTS)[:-4]
    for wrong in (b"other" + data, data + b"x", data[:8] + b"\xff\xff\xff\xff" + data[12:]):
        with pytest.raises((Damaged, zlib.error)):
            container.part(sealed(wrong))
