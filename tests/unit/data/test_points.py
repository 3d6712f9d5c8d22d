"""Clouds of points from a file that the user names."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from scene_experts.core.errors import InputError
from scene_experts.data.points import read_points
from scene_experts.data.readers.colmap_model import read_model, write_model
from support.captures import load
from support.messages import naming
from support.synthetic import Synthetic, make_capture, make_nerfstudio

XYZ = np.array([[0.25, -0.5, 0.125], [1.0, 0.5, 0.0], [-0.75, 0.25, 0.5]])
RGB = np.array([[255, 0, 51], [102, 153, 204], [0, 255, 0]])


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Synthetic:
    return make_capture(tmp_path_factory.mktemp("made"), views=8, size=(48, 32), points=100)


def write(
    path: Path, kind: str = "binary_little_endian", position: str = "double", colour: str | None = "uchar", shift: float = 0.0
) -> Path:
    head = f"ply\nformat {kind} 1.0\nelement vertex {len(XYZ)}\n" + "".join(f"property {position} {a}\n" for a in "xyz")
    head += "property float intensity\n"
    head += "".join(f"property {colour} {c}\n" for c in ("red", "green", "blue") if colour) + "end_header\n"
    rgb = RGB / 255 if colour == "float" else RGB
    if kind == "ascii":
        rows = [" ".join(map(repr, (*p, 0.5, *(c if colour else ())))) for p, c in zip((XYZ + shift).tolist(), rgb.tolist())]
        path.write_text(head + "\n".join(rows) + "\n")
        return path
    fields = [("p", "<f8" if position == "double" else "<f4", 3), ("i", "<f4")]
    table = np.zeros(len(XYZ), np.dtype([*fields, ("c", "<f4" if colour == "float" else "u1", 3)] if colour else fields))
    table["p"] = XYZ + shift
    if colour:
        table["c"] = rgb
    path.write_bytes(head.encode() + table.tobytes())
    return path


@pytest.mark.parametrize("kind", ["ascii", "binary_little_endian"])
@pytest.mark.parametrize("position", ["float", "double"])
@pytest.mark.parametrize("colour", ["uchar", "float"])
def test_clouds_of_other_programs(made: Synthetic, tmp_path: Path, kind: str, position: str, colour: str) -> None:
    capture = load(made.folder, points=write(tmp_path / "lidar.ply", kind, position, colour), normalise="none")
    assert capture.points is not None
    np.testing.assert_allclose(capture.points.xyz, XYZ, atol=1e-12)
    np.testing.assert_array_equal(capture.points.rgb, RGB)


def test_a_cloud_without_colours_is_grey_and_told(made: Synthetic, tmp_path: Path) -> None:
    capture = load(made.folder, points=write(tmp_path / "lidar.ply", colour=None))
    assert capture.points is not None and capture.points.rgb.tolist() == [[128, 128, 128]] * 3
    assert any("lidar.ply has no colours" in w for w in capture.warnings)


@pytest.mark.parametrize("text", [False, True])
def test_points_of_another_reconstruction(made: Synthetic, tmp_path: Path, text: bool) -> None:
    write_model(tmp_path, read_model(made.folder / "sparse/0"), text=text)
    points = read_points(tmp_path / f"points3D.{'txt' if text else 'bin'}", [])
    assert points is not None
    np.testing.assert_array_equal(points.xyz, made.model.xyz)
    np.testing.assert_array_equal(points.rgb, made.model.rgb)


def test_a_file_inside_the_capture_is_found_by_its_name(made: Synthetic) -> None:
    write(made.folder / "lidar.ply")
    capture = load(made.folder, points=Path("lidar.ply"))
    assert capture.points is not None and len(capture.points.xyz) == 3


def test_points_in_another_frame_are_told(made: Synthetic, tmp_path: Path) -> None:
    near, far = (load(made.folder, points=write(tmp_path / "p.ply", shift=shift)).warnings for shift in (0.0, 900.0))
    assert any("another frame" in w and "p.ply" in w for w in far) and not any("another frame" in w for w in near)


@pytest.mark.parametrize(("name", "content", "facts"), [
    ("p.ply", None, ["p.ply"]),
    ("p.ply", b"ply\nnothing", ["p.ply"]),
    ("p.las", b"LASF", ["p.las", "PLY", "points3D.bin"]),
    ("p.txt", b"1 2 3\n", ["p.txt"]),
    ("p.bin", b"\0" * 5, ["p.bin"]),
])  # fmt: skip
def test_other_files_are_refused(made: Synthetic, tmp_path: Path, name: str, content: bytes | None, facts: list[str]) -> None:
    if content is not None:
        (tmp_path / name).write_bytes(content)
    with pytest.raises(InputError, match=naming(*facts)):
        load(made.folder, points=tmp_path / name)


def test_points_and_random_points_exclude_each_other(made: Synthetic, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=naming("--points", "--init random")):
        load(made.folder, points=write(tmp_path / "p.ply"), init="random")


@pytest.mark.parametrize("name", ["pointcloud.ply", "point_cloud.ply", "points3D.ply"])
def test_a_usual_name_beside_transforms_json(tmp_path: Path, name: str) -> None:
    made = make_nerfstudio(tmp_path, views=4, size=(24, 16), points=30)
    text = (tmp_path / "transforms.json").read_text()
    (tmp_path / "transforms.json").write_text(text.replace(', "ply_file_path": "sparse_pc.ply"', ""))
    (tmp_path / "sparse_pc.ply").rename(tmp_path / name)
    points = load(tmp_path, normalise="none").points
    assert points is not None and torch.equal(points.xyz, torch.from_numpy(made.model.xyz))
    write(tmp_path / "sparse.ply")
    assert any("sparse.ply" in w and name in w and "--points" in w for w in load(tmp_path).warnings)


def test_a_missing_named_file_does_not_matter_with_points_of_ones_own(tmp_path: Path) -> None:
    make_nerfstudio(tmp_path, views=4, size=(24, 16), points=30)
    (tmp_path / "sparse_pc.ply").rename(tmp_path / "moved.ply")
    with pytest.raises(InputError, match=naming("sparse_pc.ply", "--points")):
        load(tmp_path)
    points = load(tmp_path, points=tmp_path / "moved.ply").points
    assert points is not None and len(points.xyz) == 30
