"""Point clouds in PLY files."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from scene_experts.core.errors import InputError
from scene_experts.data.readers.ply import read_points

XYZ = np.array([[1.5, -2.0, 3.0], [0.25, 4.0, -8.0]])
RGB = np.array([[255, 0, 7], [1, 2, 3]], np.uint8)


def write(path: Path, kind: str, colour: str = "uchar", extra: str = "") -> None:
    head = f"ply\nformat {kind} 1.0\ncomment by hand\nelement vertex 2\n" + "".join(f"property float {a}\n" for a in "xyz")
    head += "property double nx\n" + "".join(f"property {colour} {c}\n" for c in ("red", "green", "blue")) + extra + "end_header\n"
    rgb = RGB / 255 if colour == "float" else RGB
    if kind == "ascii":
        rows = [" ".join(map(str, (*p, 0.0, *c))) for p, c in zip(XYZ, rgb)]
        path.write_text(head + "\n".join(rows) + "\n")
        return
    order = "<" if "little" in kind else ">"
    table = np.zeros(2, np.dtype([("p", order + "f4", 3), ("n", order + "f8"), ("c", order + ("f4" if colour == "float" else "u1"), 3)]))
    table["p"], table["c"] = XYZ, rgb
    path.write_bytes(head.encode() + table.tobytes())


@pytest.mark.parametrize("kind", ["ascii", "binary_little_endian", "binary_big_endian"])
def test_three_encodings(tmp_path: Path, kind: str) -> None:
    write(tmp_path / "p.ply", kind, extra="element face 0\nproperty list uchar int vertex_indices\n")
    xyz, rgb = read_points(tmp_path / "p.ply")
    np.testing.assert_array_equal(xyz, XYZ)
    np.testing.assert_array_equal(rgb, RGB)


@pytest.mark.parametrize("kind", ["ascii", "binary_little_endian"])
def test_float_colours(tmp_path: Path, kind: str) -> None:
    write(tmp_path / "p.ply", kind, "float")
    np.testing.assert_array_equal(read_points(tmp_path / "p.ply")[1], RGB)


@pytest.mark.parametrize(("colour", "factor"), [("float", 1), ("ushort", 257), ("ushort", 1)])
@pytest.mark.parametrize("kind", ["ascii", "binary_little_endian"])
def test_colours_of_other_types(tmp_path: Path, kind: str, colour: str, factor: int) -> None:
    fields = [("p", "<f4", 3), ("c", {"float": "<f4", "ushort": "<u2"}[colour], 3)]
    head = f"ply\nformat {kind} 1.0\nelement vertex 2\n" + "".join(f"property float {a}\n" for a in "xyz")
    head += "".join(f"property {colour} {c}\n" for c in ("red", "green", "blue")) + "end_header\n"
    table = np.zeros(2, np.dtype(fields))
    table["c"] = RGB.astype(int) * factor
    rows = "\n".join(" ".join(map(str, (*p, *c))) for p, c in table.tolist()) + "\n"
    (tmp_path / "p.ply").write_bytes(head.encode() + (rows.encode() if kind == "ascii" else table.tobytes()))
    np.testing.assert_array_equal(read_points(tmp_path / "p.ply")[1], RGB)


def test_points_without_colours_are_grey(tmp_path: Path) -> None:
    (tmp_path / "p.ply").write_text(
        "ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nproperty float y\nproperty float z\nend_header\n1 2 3\n"
    )
    assert read_points(tmp_path / "p.ply")[1].tolist() == [[128, 128, 128]]


@pytest.mark.parametrize("kind", ["ascii", "binary_little_endian"])
def test_no_points(tmp_path: Path, kind: str) -> None:
    axes = "".join(f"property float {a}\n" for a in "xyz")
    (tmp_path / "p.ply").write_text(f"ply\nformat {kind} 1.0\nelement vertex 0\n{axes}end_header\n")
    xyz, rgb = read_points(tmp_path / "p.ply")
    assert xyz.shape == rgb.shape == (0, 3)


@pytest.mark.parametrize("kind", ["ascii", "binary_little_endian"])
def test_damaged_files(tmp_path: Path, kind: str) -> None:
    path = tmp_path / "p.ply"
    write(path, kind)
    whole = path.read_bytes()
    for data in (b"", b"hello", whole[:20], whole[:-9], whole.replace(b"property float z\n", b""), whole.replace(b"vertex 2", b"vertex x")):
        path.write_bytes(data)
        with pytest.raises(InputError, match=r"p\.ply"):
            read_points(path)
