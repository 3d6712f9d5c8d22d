"""Points from depth maps: where they lie, their colours, and what is left out."""

from dataclasses import replace

import numpy as np
import pytest
from PIL import Image

from scene_experts.core.errors import InputError
from scene_experts.data import depth_maps
from scene_experts.data.depth_maps import DepthFile, DepthPhoto, find_points, is_edge
from scene_experts.data.images import FrameSource
from scene_experts.data.lens import Lens
from scene_experts.data.masks import Mask
from scene_experts.data.readers.polycam import READER
from scene_experts.data.readers.reader import ReadOptions
from support.captures import load
from support.depths import make_depths
from support.foreign_poses import make_polycam
from support.messages import naming

LENS = Lens("PINHOLE", 80, 60, (50.0, 40.0, 42.0, 29.0))


def write_view(folder, depth, lens=LENS, pose=None, confidence=None):
    """A photograph whose colours say where they are, and its depth map in millimetres."""
    folder.mkdir(exist_ok=True)
    y, x = np.mgrid[: lens.height, : lens.width]
    Image.fromarray(np.stack([x * 3, y * 4, np.zeros_like(x)], 2).astype(np.uint8)).save(folder / "photo.png")
    Image.fromarray(np.rint(depth * 1000).astype(np.uint16)).save(folder / "depth.png")
    if confidence is not None:
        Image.fromarray(confidence.astype(np.uint8)).save(folder / "sure.png")
    file = DepthFile(folder / "depth.png", 0.001, None if confidence is None else folder / "sure.png")
    return DepthPhoto(FrameSource(folder / "photo.png", lens, (lens.width, lens.height)), np.eye(4) if pose is None else pose, file)


def project(points, view):
    x, y, z = (points @ view.world_to_cam[:3, :3].T + view.world_to_cam[:3, 3]).T
    return LENS.fx * x / z + LENS.cx, LENS.fy * y / z + LENS.cy, z


def test_points_are_where_their_pixels_see_them(tmp_path):
    turn = np.array([[0.0, 0, 1, 0.3], [0, 1, 0, -0.2], [-1, 0, 0, 0.5], [0, 0, 0, 1]])
    depth = 2 + np.mgrid[:30, :40][1] * 0.01  # a map of half the size of its photograph
    view = write_view(tmp_path / "a", depth, pose=turn)
    points = find_points([view])
    u, v, z = project(points.xyz.numpy(), view)
    assert len(z) > 1000 and np.allclose(z, 2 + (u / 2 - 0.5) * 0.01, atol=1e-3)
    assert np.allclose(points.rgb[:, 0].numpy(), 3 * (u - 0.5), atol=4) and np.allclose(points.rgb[:, 1].numpy(), 4 * (v - 0.5), atol=5)


def test_holes_edges_and_doubtful_pixels_are_left_out(tmp_path):
    depth = np.full((30, 40), 2.0)
    depth[:, 20:] = 3.0
    depth[5:10, 5:10] = 0
    sure = np.full((30, 40), 255)
    sure[20:] = 127
    view = write_view(tmp_path / "a", depth, confidence=sure)
    u, v, z = project(find_points([view]).xyz.numpy(), view)
    columns, rows = np.floor(u / 2).astype(int), np.floor(v / 2).astype(int)
    assert not {19, 20} & set(columns) and {18, 21} <= set(columns) and rows.max() == 19
    assert not ((rows >= 5) & (rows < 10) & (columns >= 5) & (columns < 10)).any() and set(np.round(z, 3)) == {2.0, 3.0}
    assert is_edge(np.array([[1.0, 1.04, 1.2], [0.0, 1.04, 1.2]])).tolist() == [[False, True, True], [False, True, True]]
    assert find_points([write_view(tmp_path / "b", np.zeros((30, 40)))]) is None and find_points([]) is None


def test_many_points_become_at_most_so_many(tmp_path, monkeypatch):
    monkeypatch.setattr(depth_maps, "MOST", 200)
    points = find_points([write_view(tmp_path / "a", np.full((60, 80), 2.0))])
    assert 100 < len(points.xyz) <= 200
    assert len(np.unique(points.xyz.numpy(), axis=0)) == len(points.xyz)


def test_maps_of_another_shape_are_refused(tmp_path):
    with pytest.raises(InputError, match=naming("depth.png", "40x40")):
        find_points([write_view(tmp_path / "a", np.ones((40, 40)))])
    view = write_view(tmp_path / "b", np.ones((30, 40)), confidence=np.ones((3, 4)))
    with pytest.raises(InputError, match=naming("sure.png", "4x3")):
        find_points([view])
    for other in (Image.new("RGB", (40, 30)), Image.new("L", (40, 30)), Image.fromarray(np.ones((30, 40), np.float32))):
        other.save(view.depth.path.with_suffix(".tif"))
        with pytest.raises(InputError, match=naming("depth.tif", "16 bits")):
            find_points([replace(view, depth=DepthFile(view.depth.path.with_suffix(".tif"), 0.001))])
    view.depth.path.write_bytes(view.depth.path.read_bytes()[:60])
    with pytest.raises(InputError, match=r"whole depth map at .*depth\.png"):
        find_points([view])


def test_pixels_that_a_mask_leaves_out_are_no_points(tmp_path):
    view = write_view(tmp_path / "a", np.full((30, 40), 2.0))
    Image.fromarray(np.repeat([[0] * 40 + [255] * 40], 60, 0).astype(np.uint8)).save(tmp_path / "mask.png")
    masked = replace(view, source=replace(view.source, mask=Mask(tmp_path / "mask.png")))
    u, _, _ = project(find_points([masked]).xyz.numpy(), view)
    assert u.min() > 40 and u.max() > 78


def test_points_of_a_turned_photograph_have_its_colours(tmp_path):
    view = write_view(tmp_path / "a", np.tile(np.linspace(1, 2, 40), (30, 1)))
    picture = Image.open(view.source.path)
    exif = picture.getexif()
    exif[0x0112] = 6  # clockwise: what is right becomes what is below
    picture.save(view.source.path, exif=exif)
    upright = Lens("PINHOLE", 60, 80, (50.0, 50.0, 30.0, 40.0))
    points = find_points([replace(view, source=replace(view.source, lens=upright, turn=True))])
    _, y, z = points.xyz.numpy().T
    rows = 50 * y / z + 40
    assert np.allclose(z, 1 + (rows / 2 - 0.5) / 39, atol=2e-3) and np.allclose(points.rgb[:, 0].numpy(), 3 * (rows - 0.5), atol=4)


def test_only_training_views_give_points(tmp_path):
    folder = make_depths(tmp_path / "planes", views=8)
    whole, half = load(folder, split="none"), load(folder, split="mod2")
    assert [any(f"those of {n} depth maps" in w for w in c.warnings) for n, c in ((8, whole), (4, half))] == [True, True]
    one = load(folder, split="none", leave_out=tuple(f"images/{i}.png" for i in range(1, 8)))
    assert any("that of one depth map;" in w for w in one.warnings)


def test_maps_that_know_nothing_are_named(tmp_path):
    folder = make_depths(tmp_path / "planes", times=0.0)
    with pytest.raises(InputError, match="expected 3D points in the depth maps"):
        load(folder, init="points")


def test_a_capture_of_a_phone_with_lidar_starts_from_its_depth(tmp_path):
    made = make_polycam(tmp_path)
    names = sorted(path.stem for path in (tmp_path / "keyframes/corrected_cameras").iterdir())
    (tmp_path / "keyframes/depth").mkdir()
    for path in tmp_path.glob("*.ply"):
        path.unlink()
    for name in names[:3]:
        Image.fromarray(np.full((32, 48), 2500, np.uint16)).save(tmp_path / f"keyframes/depth/{name}.png")
    raw = READER.read(tmp_path, ReadOptions())
    assert sum(image.depth is not None for image in raw.images) == 3 and not any("no points" in w for w in raw.warnings)
    capture = load(tmp_path, split="none")
    assert capture.points is not None and any("those of 3 depth maps" in w for w in capture.warnings) and made.images
    assert not any("depth maps" in w for w in load(tmp_path, init="random").warnings)
