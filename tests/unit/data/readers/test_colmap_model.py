"""COLMAP reconstructions: both formats, 2D tracks, and every kind of damaged file."""

from __future__ import annotations

import struct
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from scene_experts.core.errors import InputError
from scene_experts.data.readers.colmap_model import ColmapImage, Model, find_models, read_model, write_model
from support.lenses import LENSES
from support.messages import naming


def model() -> Model:
    cameras = {i + 3: lens for i, lens in enumerate(LENSES)}
    rng = np.random.default_rng(0)
    images = []
    for i in range(14):
        q, t = rng.standard_normal(4), rng.standard_normal(3)
        q /= np.linalg.norm(q)
        images.append(ColmapImage(i + 1, f"left cam/é {i}.b.jpg", tuple(map(float, q)), tuple(map(float, t)), 3 + i % len(LENSES)))  # type: ignore[arg-type]
    count = 50
    return Model(
        cameras,
        tuple(images),
        np.arange(10, 10 + count),
        rng.standard_normal((count, 3)) * 1e5,
        rng.integers(0, 256, (count, 3)).astype(np.uint8),
        rng.random(count),
    )


def assert_same(a: Model, b: Model) -> None:
    assert a.cameras == b.cameras and a.images == b.images
    for name in ("ids", "xyz", "rgb", "error"):
        np.testing.assert_array_equal(getattr(a, name), getattr(b, name))


@pytest.mark.parametrize("text", [False, True])
def test_written_models_read_back_exactly(tmp_path: Path, text: bool) -> None:
    made = model()
    write_model(tmp_path, made, text=text)
    assert_same(read_model(tmp_path), made)


def with_tracks(folder: Path) -> None:
    """A binary model written by hand: 1 camera, 2 images with 2 and 1 observations, 2 points with tracks of 3 and 0."""
    (folder / "cameras.bin").write_bytes(struct.pack("<QiiQQ4d", 1, 7, 1, 640, 480, 500.0, 501.0, 320.5, 240.25))
    first = struct.pack("<i7di", 1, 1, 0, 0, 0, 0.5, 0, 0, 7) + b"a.png\0" + struct.pack("<Qddqddq", 2, 10.5, 11.5, 42, 3, 4, -1)
    second = struct.pack("<i7di", 2, 0, 1, 0, 0, 0, 0, 1, 7) + b"sub/b.png\0" + struct.pack("<Qddq", 1, 1, 2, 43)
    (folder / "images.bin").write_bytes(struct.pack("<Q", 2) + first + second)
    one = struct.pack("<Q3d3Bd", 42, 1, 2, 3, 10, 20, 30, 0.25) + struct.pack("<Q6i", 3, 1, 0, 2, 0, 2, 1)
    two = struct.pack("<Q3d3Bd", 43, 4, 5, 6, 40, 50, 60, 0.5) + struct.pack("<Q", 0)
    (folder / "points3D.bin").write_bytes(struct.pack("<Q", 2) + one + two)


def test_tracks_are_read_or_skipped(tmp_path: Path) -> None:
    with_tracks(tmp_path)
    got = read_model(tmp_path, observations=True)
    assert got.cameras[7].params == (500.0, 501.0, 320.5, 240.25)
    assert [i.name for i in got.images] == ["a.png", "sub/b.png"]
    np.testing.assert_array_equal(got.xyz, [[1, 2, 3], [4, 5, 6]])
    np.testing.assert_array_equal(got.rgb, [[10, 20, 30], [40, 50, 60]])
    np.testing.assert_array_equal(got.observations[1][0], [[10.5, 11.5], [3, 4]])
    np.testing.assert_array_equal(got.observations[1][1], [42, -1])
    np.testing.assert_allclose(got.images[0].world_to_cam(), [[1, 0, 0, 0.5], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]])
    np.testing.assert_allclose(got.images[1].world_to_cam()[:3, :3], np.diag([1, -1, -1]), atol=1e-12)
    assert read_model(tmp_path).observations == {}


def test_text_with_observations_and_blank_lines(tmp_path: Path) -> None:
    (tmp_path / "cameras.txt").write_text("# comment\n  # another\n1 SIMPLE_RADIAL 64 48 50 32 24 0.1\n")
    (tmp_path / "images.txt").write_text("# c\n1 1 0 0 0 0 0 1 1 a b.png\n1.5 2.5 9 3 4 -1\n2 1 0 0 0 0 0 2 1 c.png\n\n")
    (tmp_path / "points3D.txt").write_text("9 1 2 3 255 0 7 0.5 1 0 2 0\n")
    got = read_model(tmp_path, observations=True)
    assert [i.name for i in got.images] == ["a b.png", "c.png"]
    np.testing.assert_array_equal(got.observations[1][0], [[1.5, 2.5], [3, 4]])
    assert len(got.observations[2][0]) == 0
    np.testing.assert_array_equal(got.rgb, [[255, 0, 7]])


def test_text_without_lines_of_observations_loses_no_image(tmp_path: Path) -> None:
    (tmp_path / "cameras.txt").write_text("1 SIMPLE_RADIAL 64 48 50 32 24 0.1\n")
    (tmp_path / "images.txt").write_text("1 1 0 0 0 0 0 1 1 a.png\n2 1 0 0 0 0 0 2 1 b.png\n")
    with pytest.raises(InputError, match=r"observations of a\.png"):
        read_model(tmp_path)
    (tmp_path / "images.txt").write_text("# c\n\n1 1 0 0 0 0 0 1 1 a.png\n1 2 -1\n\n2 1 0 0 0 0 0 2 1 b.png\n")  # COLMAP skips blank lines
    assert [i.name for i in read_model(tmp_path).images] == ["a.png", "b.png"]


def test_75_thousand_points_are_read_within_two_seconds(tmp_path: Path) -> None:
    made, count = model(), 75_000
    rng = np.random.default_rng(0)
    made = replace(
        made,
        ids=np.arange(count),
        xyz=rng.random((count, 3)),
        rgb=np.zeros((count, 3), np.uint8),
        error=np.zeros(count),
        images=made.images,
    )
    write_model(tmp_path, made)
    start = time.process_time()
    assert len(read_model(tmp_path).xyz) == count
    assert time.process_time() - start < 1.5


@pytest.mark.parametrize("place", ["sparse/0", "sparse", "colmap/sparse/0", "."])
def test_models_are_found(tmp_path: Path, place: str) -> None:
    write_model(tmp_path / place, model())
    assert find_models(tmp_path) == [tmp_path / place]


def test_no_model(tmp_path: Path) -> None:
    assert find_models(tmp_path) == []


@pytest.mark.parametrize("name", ["cameras", "images"])
def test_missing_files_are_named(tmp_path: Path, name: str) -> None:
    write_model(tmp_path, model())
    (tmp_path / f"{name}.bin").unlink()
    with pytest.raises(InputError, match=naming(f"{name}.bin", f"{name}.txt")):
        read_model(tmp_path)


def test_without_a_points_file_there_are_no_points(tmp_path: Path) -> None:
    write_model(tmp_path, model())
    (tmp_path / "points3D.bin").unlink()
    assert len(read_model(tmp_path).xyz) == 0


@pytest.mark.parametrize("name", ["cameras", "images", "points3D"])
def test_a_file_truncated_anywhere_is_an_input_error(tmp_path: Path, name: str) -> None:
    with_tracks(tmp_path)
    whole = (tmp_path / f"{name}.bin").read_bytes()
    for size in range(len(whole)):
        (tmp_path / f"{name}.bin").write_bytes(whole[:size])
        with pytest.raises(InputError, match=f"{name}.bin"):
            read_model(tmp_path)


@pytest.mark.parametrize("name", ["cameras", "images", "points3D"])
def test_an_absurd_count_is_an_input_error_at_once(tmp_path: Path, name: str) -> None:
    with_tracks(tmp_path)
    whole = (tmp_path / f"{name}.bin").read_bytes()
    (tmp_path / f"{name}.bin").write_bytes(struct.pack("<Q", 1 << 60) + whole[8:])
    with pytest.raises(InputError, match=f"{name}.bin"):
        read_model(tmp_path)


@pytest.mark.parametrize("name", ["cameras", "images", "points3D"])
def test_damaged_text(tmp_path: Path, name: str) -> None:
    write_model(tmp_path, model(), text=True)
    path = tmp_path / f"{name}.txt"
    path.write_text(path.read_text()[: path.read_text().rstrip().rfind("\n") + 5])
    with pytest.raises(InputError, match=name):
        read_model(tmp_path)


def test_unknown_model_number(tmp_path: Path) -> None:
    with_tracks(tmp_path)
    (tmp_path / "cameras.bin").write_bytes(struct.pack("<QiiQQ4d", 1, 7, 99, 640, 480, 500.0, 501.0, 320.5, 240.25))
    with pytest.raises(InputError, match="99"):
        read_model(tmp_path)


def test_unknown_model_name(tmp_path: Path) -> None:
    write_model(tmp_path, model(), text=True)
    (tmp_path / "cameras.txt").write_text("3 WIBBLE 64 48 50 32 24\n")
    with pytest.raises(InputError, match="WIBBLE"):
        read_model(tmp_path)


@pytest.mark.parametrize(("number", "name"), [(18, "colmap image_undistorter"), (99, "colmap image_undistorter")])
def test_the_refusal_of_a_model_says_what_to_do(tmp_path: Path, number: int, name: str) -> None:
    with_tracks(tmp_path)
    (tmp_path / "cameras.bin").write_bytes(struct.pack("<QiiQQ4d", 1, 7, number, 640, 480, 500.0, 501.0, 320.5, 240.25))
    with pytest.raises(InputError, match=name):
        read_model(tmp_path)


@pytest.mark.parametrize("encoding", ["utf-8-sig", "utf-16"])
def test_text_with_a_byte_order_mark(tmp_path: Path, encoding: str) -> None:
    write_model(tmp_path, model(), text=True)
    before = read_model(tmp_path)
    for path in tmp_path.glob("*.txt"):
        path.write_bytes(path.read_text().replace("\n", "\r\n").encode(encoding))
    after = read_model(tmp_path)
    assert (after.cameras, after.images) == (before.cameras, before.images)
    np.testing.assert_array_equal(after.xyz, before.xyz)


def test_sizes_as_decimals(tmp_path: Path) -> None:
    write_model(tmp_path, model(), text=True)
    path = tmp_path / "cameras.txt"
    whole, lens = path.read_text(), read_model(tmp_path).cameras[3]
    path.write_text(whole.replace(f" {lens.width} {lens.height} ", f" {lens.width}.0 {lens.height}.000000 "))
    assert read_model(tmp_path).cameras[3] == lens
    path.write_text(whole.replace(f" {lens.width} {lens.height} ", f" {lens.width}.5 {lens.height} "))
    with pytest.raises(InputError, match="cameras"):
        read_model(tmp_path)


def test_colours_of_text_as_fractions(tmp_path: Path) -> None:
    write_model(tmp_path, model(), text=True)
    before = read_model(tmp_path)
    rows = [f"{i} {x} {y} {z} {r / 255:.6f} {g / 255:.6f} {b / 255:.6f} 0.5" for i, ((x, y, z), (r, g, b)) in
            enumerate(zip(before.xyz.tolist(), before.rgb.tolist()))]  # fmt: skip
    (tmp_path / "points3D.txt").write_text("\n".join(rows) + "\n")
    after = read_model(tmp_path)
    np.testing.assert_array_equal(after.rgb, before.rgb)
    assert "fractions of 1" in after.notes[0]


def test_no_cameras_and_no_images(tmp_path: Path) -> None:
    write_model(tmp_path, replace(model(), cameras={}))
    with pytest.raises(InputError, match=r"cameras\.bin"):
        read_model(tmp_path)
    write_model(tmp_path, replace(model(), images=()))
    with pytest.raises(InputError, match=r"images\.bin"):
        read_model(tmp_path)


@pytest.mark.parametrize(
    "bad", [{"quaternion": (float("nan"), 0.0, 0.0, 1.0)}, {"translation": (0.0, float("inf"), 0.0)}, {"quaternion": (0.0,) * 4}]
)
def test_poses_that_are_not_finite(tmp_path: Path, bad: dict) -> None:
    made = model()
    write_model(tmp_path, replace(made, images=(replace(made.images[0], **bad), *made.images[1:])))
    with pytest.raises(InputError, match=r"images\.bin"):
        read_model(tmp_path)


@pytest.mark.parametrize("name", ["", "."])
def test_images_without_a_name(tmp_path: Path, name: str) -> None:
    made = model()
    write_model(tmp_path, replace(made, images=(replace(made.images[0], name=name), *made.images[1:])))
    with pytest.raises(InputError, match=r"images\.bin"):
        read_model(tmp_path)


@pytest.mark.parametrize("text", [False, True])
def test_one_point(tmp_path: Path, text: bool) -> None:
    made = model()
    made = replace(made, ids=made.ids[:1], xyz=made.xyz[:1], rgb=made.rgb[:1], error=made.error[:1])
    write_model(tmp_path, made, text=text)
    got = read_model(tmp_path)
    assert_same(got, made)
    for array in (got.xyz, got.rgb, got.error):
        assert torch.from_numpy(array).shape == array.shape


def test_image_of_an_unknown_camera(tmp_path: Path) -> None:
    made = model()
    write_model(tmp_path, replace(made, images=(replace(made.images[0], camera_id=999),)))
    with pytest.raises(InputError, match="999"):
        read_model(tmp_path)
