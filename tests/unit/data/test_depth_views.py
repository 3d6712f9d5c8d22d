"""Depth maps as training sees them: of the shape, the lens and the side of their photographs."""

import numpy as np
import pytest
import torch
from PIL import Image

from scene_experts.core.errors import InputError
from scene_experts.data.depth_maps import DepthFile
from scene_experts.data.depth_views import LONGEST, read_map
from scene_experts.data.images import FrameSource
from scene_experts.data.lens import Lens, to_pinhole
from support.captures import load
from support.depths import make_depths
from support.messages import naming

PINHOLE = Lens("PINHOLE", 80, 60, (50.0, 40.0, 42.0, 29.0))
BENT = Lens("OPENCV", 80, 60, (60.0, 60.0, 40.0, 30.0, -0.2, 0.03, 0.002, -0.001))


def slanted(u, v):
    """The depth along z of a slanted plane, by the ray (u, v, 1)."""
    return 2 / (1 + 0.3 * u - 0.2 * v)


def write(folder, lens, map_size, size, values=None, turn=False, orientation=1):
    """A photograph and its depth map at another size; `values` of the map, by default of the plane."""
    photograph = Image.new("RGB", (lens.width, lens.height))
    exif = photograph.getexif()
    exif[0x0112] = orientation
    photograph.save(folder / "photo.png", exif=exif)
    if values is None:
        small = lens.resize(*map_size)
        x, y = np.meshgrid(np.arange(map_size[0]) + 0.5, np.arange(map_size[1]) + 0.5)
        values = slanted(*small.undistort((x - small.cx) / small.fx, (y - small.cy) / small.fy))
    Image.fromarray((1000 * values).round().astype(np.uint16)).save(folder / "depth.png")
    return DepthFile(folder / "depth.png", 0.001), FrameSource(folder / "photo.png", lens, size, turn=turn)


@pytest.mark.parametrize("lens", [PINHOLE, BENT], ids=["pinhole", "distorted"])
@pytest.mark.parametrize("map_size", [(40, 30), (160, 120)])
def test_a_map_is_undistorted_and_resized_like_its_photograph(tmp_path, lens, map_size):
    flat = to_pinhole(lens)
    size = (round(flat.width * 0.7), round(flat.height * 0.7))
    depth = read_map(*write(tmp_path, lens, map_size, size)).numpy()
    x, y = np.meshgrid((np.arange(size[0]) + 0.5) * flat.width / size[0], (np.arange(size[1]) + 0.5) * flat.height / size[1])
    expected = slanted((x - flat.cx) / flat.fx, (y - flat.cy) / flat.fy)
    assert depth.shape == (size[1], size[0]) and depth.dtype == np.float32
    inside = depth > 0
    assert inside[3:-3, 3:-3].all() and np.abs(depth - expected)[inside].max() < 0.004


def test_what_is_not_known_stays_so(tmp_path):
    values = np.full((30, 40), 2.0)
    values[10:20, 10:20] = 0
    depth = read_map(*write(tmp_path, PINHOLE, (40, 30), (80, 60), values))
    assert not depth[20:40, 20:40].any() and not depth[19, 25] and float(depth[17, 25]) == pytest.approx(2.0)
    assert set(np.round(depth.unique().tolist(), 3)) == {0.0, 2.0}


def test_a_map_is_turned_with_its_photograph(tmp_path):
    values = np.tile(np.linspace(1, 1.5, 40), (30, 1))  # grows to the right as stored
    upright = Lens("PINHOLE", 60, 80, (50.0, 50.0, 30.0, 40.0))  # of the turned photograph
    file, source = write(tmp_path, PINHOLE, (40, 30), (30, 40), values)
    photograph = Image.new("RGB", (80, 60))
    exif = photograph.getexif()
    exif[0x0112] = 6  # to be turned clockwise
    photograph.save(tmp_path / "photo.png", exif=exif)
    turned = read_map(file, FrameSource(source.path, upright, (30, 40), turn=True))
    assert turned.shape == (40, 30)
    torch.testing.assert_close(turned[:, 15], torch.from_numpy(values[15]).float(), atol=2e-3, rtol=0)  # right became down
    Image.fromarray((1000 * np.rot90(values, -1)).round().astype(np.uint16)).save(file.path)  # a map that is turned already
    torch.testing.assert_close(read_map(file, FrameSource(source.path, upright, (30, 40), turn=True)), turned)


def test_a_large_map_has_at_most_so_many_pixels(tmp_path):
    lens = Lens("PINHOLE", 1600, 1200, (900.0, 900.0, 800.0, 600.0))
    assert read_map(*write(tmp_path, lens, (40, 30), (1200, 900))).shape == (LONGEST * 3 // 4, LONGEST)


def test_a_map_of_another_shape_is_refused(tmp_path):
    file, source = write(tmp_path, PINHOLE, (40, 30), (80, 60), np.ones((40, 40)))
    with pytest.raises(InputError, match=naming("depth.png", "40x40")):
        read_map(file, source)


def test_a_capture_has_depth_in_trained_units(tmp_path):
    capture = load(make_depths(tmp_path / "planes"), resolution="longest:32")
    depth = capture.depth(2)
    assert depth is not None and depth.shape == (24, 32)
    known = depth[depth > 0] / capture.world.scale
    assert float(known.min()) > 2.9 and float(known.max()) < 4.1 and capture.world.scale != 1
