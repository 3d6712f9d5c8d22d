"""Tables of PLY files in three encodings, and headers that lie."""

import numpy as np
import pytest

from scene_experts.core.errors import InputError
from scene_experts.core.reading.budget import PLY
from scene_experts.core.reading.source import opening
from scene_experts.core.reading.vertices import read_header, read_table
from support.messages import naming

HEAD = "ply\nformat {}\nelement vertex {}\nproperty float x\nproperty uchar red\nelement face 1\nproperty list uchar int v\nend_header\n"


def table(path):
    with opening(path, PLY) as source:
        header = read_header(source)
        return header, read_table(source, header)


@pytest.mark.parametrize("order", ["<", ">"])
def test_binary(tmp_path, order):
    rows = np.array([(1.5, 3), (-2.0, 255)], np.dtype([("x", order + "f4"), ("red", "u1")]))
    name = {"<": "binary_little_endian 1.0", ">": "binary_big_endian 1.0"}[order]
    (tmp_path / "a.ply").write_bytes(HEAD.format(name, 2).encode() + rows.tobytes() + b"faces")
    header, found = table(tmp_path / "a.ply")
    assert not header.ascii and found["x"].tolist() == [1.5, -2.0] and found["red"].tolist() == [3, 255]


def test_ascii(tmp_path):
    (tmp_path / "a.ply").write_text(HEAD.format("ascii 1.0", 3) + "1.5 3\r\n\n-2e3 255\n0.1 0\n3 0 0 0\n")
    header, found = table(tmp_path / "a.ply")
    assert header.ascii and found.tolist() == [[1.5, 3], [-2000, 255], [0.1, 0]]


@pytest.mark.parametrize("count", ["1e30", "-1", "99999999999999", "9" * 5000, "2", "", "0x1"])
@pytest.mark.parametrize("kind", ["ascii 1.0", "binary_little_endian 1.0"])
def test_counts_that_lie(tmp_path, count, kind):
    (tmp_path / "a.ply").write_text(HEAD.format(kind, count) + "1 2\n")
    with pytest.raises(InputError, match=naming("a.ply")):
        table(tmp_path / "a.ply")


def test_lines_that_lie(tmp_path):
    for line in ("1 2 3", "1", "x y", "1 " * 5000, "\xff"):
        (tmp_path / "a.ply").write_bytes((HEAD.format("ascii 1.0", 1) + line + "\n").encode("latin-1"))
        with pytest.raises(InputError, match=naming("a.ply")):
            table(tmp_path / "a.ply")
    (tmp_path / "a.ply").write_text(HEAD.replace("property float x", "property float x\n" * 5000).format("ascii", 1))
    with pytest.raises(InputError, match=naming("4,096")):
        table(tmp_path / "a.ply")
