"""COLMAP captures: the reconstruction and the photographs that belong to it."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from scene_experts.core.errors import InputError
from scene_experts.data.equirectangular import VIEWS, find_places, sample
from scene_experts.data.lens import Lens
from scene_experts.data.readers.colmap import READER
from scene_experts.data.readers.colmap_model import ColmapImage, Model, read_model, write_model
from scene_experts.data.readers.reader import ReadOptions
from support.captures import load
from support.messages import naming
from support.rooms import draw_panorama, paint_walls
from support.synthetic import Synthetic, make_capture


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Synthetic:
    return make_capture(tmp_path_factory.mktemp("made"), views=10, size=(48, 32), points=300)


@pytest.fixture
def copy(made: Synthetic, tmp_path: Path) -> Path:
    return Path(shutil.copytree(made.folder, tmp_path / "copy"))


def test_a_reconstruction_states_neither_split_nor_bounds(made: Synthetic) -> None:
    raw = READER.read(made.folder, ReadOptions())
    assert [image.name for image in raw.images] == sorted(made.images) and not any(image.test for image in raw.images)
    assert raw.alpha_over is None and raw.bounds is None and not raw.states_split and "points3D" in raw.points_source


def test_text_models_load_like_binary_ones(made: Synthetic, copy: Path) -> None:
    model = read_model(copy / "sparse/0")
    shutil.rmtree(copy / "sparse/0")
    write_model(copy / "sparse/0", model, text=True)
    a, b = load(made.folder), load(copy)
    assert all(torch.equal(v.camera.world_to_cam, w.camera.world_to_cam) for v, w in zip(a.views, b.views))
    assert a.points is not None and b.points is not None and torch.equal(a.points.xyz, b.points.xyz)


def test_absent_images(copy: Path) -> None:
    for i in (3, 5):
        (copy / f"images/view_{i:03d}.png").unlink()
    with pytest.raises(InputError, match=naming(10, 2, "view_003.png", "--missing drop")):
        load(copy)
    capture = load(copy, missing="drop")
    assert len(capture.views) == 8 and any("2" in w and "10" in w for w in capture.warnings)
    shutil.rmtree(copy / "images")
    with pytest.raises(InputError, match="10"):
        load(copy, missing="drop")


def test_the_same_image_twice(copy: Path) -> None:
    model = read_model(copy / "sparse/0")
    write_model(copy / "sparse/0", replace(model, images=(*model.images, replace(model.images[0], id=99))))
    with pytest.raises(InputError):
        load(copy)


def test_several_reconstructions(copy: Path) -> None:
    """The one with the most photographs is read, whatever its number, and the counts are told."""
    whole = read_model(copy / "sparse/0")
    for text in (False, True):
        shutil.rmtree(copy / "sparse")
        write_model(copy / "sparse/0", replace(whole, images=whole.images[:2]), text=text)
        write_model(copy / "sparse/7", whole, text=text)
        capture = load(copy)
        assert len(capture.views) == 10
        told = next(w for w in capture.warnings if "reconstructions" in w)
        assert all(part in told for part in ("sparse/0 has 2", "sparse/7 has 10", "sparse/7 is read", "--model sparse/0"))
        assert len(load(copy, model="sparse/0").views) == 2
        assert len(load(copy, model=str(copy / "sparse/7")).views) == 10
    (copy / "sparse/7/images.txt").write_text("no model\n")
    assert len(load(copy).views) == 2
    with pytest.raises(InputError, match=naming("sparse/3", "--model")):
        load(copy, model="sparse/3")
    with pytest.raises(InputError, match=naming("sparse/0", "sparse/7", "--model")):
        load(copy, model="images")


@pytest.mark.parametrize("place", ["sparse/1", "sparse/aligned", "colmap/sparse/2", "sparse"])
def test_a_reconstruction_of_another_number(made: Synthetic, copy: Path, place: str) -> None:
    model = read_model(copy / "sparse/0")
    shutil.rmtree(copy / "sparse")
    write_model(copy / place, model)
    capture = load(copy)
    assert len(capture.views) == 10 and not any("reconstructions" in w for w in capture.warnings)


def test_the_first_of_equal_reconstructions(copy: Path) -> None:
    shutil.copytree(copy / "sparse/0", copy / "sparse/10")
    shutil.copytree(copy / "sparse/0", copy / "sparse/2")
    told = next(w for w in load(copy).warnings if "reconstructions" in w)
    assert told.index("sparse/2") < told.index("sparse/10") and "sparse/0 is read" in told


def write_cloud(path: Path, count: int, colours: bool = True) -> None:
    """Write a binary PLY of doubles: points on a line through the scene, red."""
    head = f"ply\nformat binary_little_endian 1.0\nelement vertex {count}\n" + "".join(f"property double {a}\n" for a in "xyz")
    head += "".join(f"property uchar {c}\n" for c in ("red", "green", "blue") if colours) + "end_header\n"
    rows = np.zeros(count, np.dtype([("p", "<f8", 3), ("c", "u1", 3)] if colours else [("p", "<f8", 3)]))
    rows["p"][:, 0] = np.linspace(-1, 1, count)
    if colours:
        rows["c"] = (200, 10, 20)
    path.write_bytes(head.encode() + rows.tobytes())


@pytest.mark.parametrize("name", ["points3D.ply", "points3d.ply", "PointCloud.ply"])
@pytest.mark.parametrize("place", ["sparse/0", "."])
def test_points_in_a_ply_file_alone(copy: Path, name: str, place: str) -> None:
    (copy / "sparse/0/points3D.bin").unlink()
    write_cloud(copy / place / name, 40)
    capture = load(copy)
    assert capture.points is not None and len(capture.points.xyz) == 40
    assert capture.points.rgb.tolist() == [[200, 10, 20]] * 40
    assert any(name in w and "40" in w and "--points" in w for w in capture.warnings)


def test_an_empty_points_file_gives_way_to_a_ply_file(copy: Path) -> None:
    model = read_model(copy / "sparse/0")
    write_model(copy / "sparse/0", replace(model, ids=model.ids[:0], xyz=model.xyz[:0], rgb=model.rgb[:0], error=model.error[:0]))
    write_cloud(copy / "sparse/0/points3D.ply", 40)
    capture = load(copy)
    assert capture.points is not None and len(capture.points.xyz) == 40
    assert any("points3D.bin is empty" in w for w in capture.warnings)


def test_a_ply_file_of_another_count_is_told(copy: Path) -> None:
    write_cloud(copy / "sparse/0/points3D.ply", 300)
    assert not any("points3D.ply" in w for w in load(copy).warnings)
    write_cloud(copy / "sparse/0/points3D.ply", 40)
    capture = load(copy)
    assert capture.points is not None and len(capture.points.xyz) == 300
    assert any(all(part in w for part in ("points3D.bin (300)", "points3D.ply (40)", "--points")) for w in capture.warnings)


@pytest.mark.parametrize("part", ["cameras.bin", "images.bin", "points3D.bin"])
def test_truncated_models(copy: Path, part: str) -> None:
    path = copy / "sparse/0" / part
    path.write_bytes(path.read_bytes()[:-5])
    with pytest.raises(InputError, match=part):
        load(copy)


@pytest.mark.parametrize("text", [False, True])
def test_panoramas_are_read_as_views_of_them(tmp_path, text):
    width, walls, place = 256, paint_walls(64), np.array([0.3, -0.2, 0.1])
    panorama = draw_panorama(walls, place, 0.0, width)
    (tmp_path / "images" / "a").mkdir(parents=True)
    Image.fromarray(panorama).save(tmp_path / "images" / "a" / "0.png")
    count = np.full((width // 2, width), 255, np.uint8)
    count[:, : width // 2] = 0
    Image.fromarray(count).save(tmp_path / "images" / "a" / "0_mask.png")
    cameras = {1: Lens("EQUIRECTANGULAR", width, width // 2, (width, width // 2))}
    image = ColmapImage(1, "a/0.png", (1.0, 0.0, 0.0, 0.0), tuple((-place).tolist()), 1)
    points = np.random.default_rng(0).uniform(-1, 1, (40, 3))
    model = Model(cameras, (image,), np.arange(40), points, np.zeros((40, 3), np.uint8), np.ones(40))
    (tmp_path / "sparse" / "0").mkdir(parents=True)
    write_model(tmp_path / "sparse" / "0", model, text=text)
    capture = load(tmp_path, split="none", normalise="none")
    assert len(capture.views) == len(VIEWS) and capture.views[0].name == "a/0/yaw000_pitch+35.png"
    for index, view in enumerate(capture.views):
        cut = next(v for v in VIEWS if v.folder in view.name)
        assert np.allclose(view.camera.position, place, atol=1e-5)
        assert np.allclose(view.camera.world_to_cam[:3, :3], cut.rig_from_view.T, atol=1e-6)
        frame, side = capture.frame(index), view.camera.width
        wanted = sample(panorama, find_places(cut, side, (width, width // 2)))
        assert np.median(np.abs(frame.rgb.numpy().astype(int) - wanted)) <= 5 and view.camera.fov == pytest.approx(np.pi / 2)
    masks = {view.name: capture.frame(i).mask for i, view in enumerate(capture.views)}
    left, right = masks["a/0/yaw270_pitch+35.png"], masks["a/0/yaw090_pitch+35.png"]
    assert right is None and left is not None and float(left.float().mean()) < 0.02
