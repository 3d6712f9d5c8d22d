"""SmallPictures pictures are means of areas, and their cameras fit them."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from scene_experts.core.types import Camera
from scene_experts.data.dense.pictures import UNCOUNTED, reduce_pictures
from scene_experts.data.views import Frame
from support.captures import load
from support.planes import make_planes, plane


@pytest.fixture(scope="module")
def capture(tmp_path_factory):
    capture = load(make_planes(tmp_path_factory.mktemp("planes") / "capture", plane(4.0), views=9))
    yield capture
    capture.images.close()


class Shown:
    """A capture with other frames."""

    def __init__(self, capture, frames):
        self.train, self.views, self.images, self.frames = tuple(frames), capture.views, capture.images, frames

    def frame(self, index):
        return self.frames[index]


def test_a_pixel_is_the_mean_of_its_area(capture):
    rgb = torch.randint(0, 255, (48, 64, 3), generator=torch.Generator().manual_seed(0), dtype=torch.uint8)
    found = reduce_pictures(Shown(capture, {1: Frame(rgb, None)}), 32)
    assert found.size.tolist() == [[32, 24]] and found.start.tolist() == [0, 768]
    mean = rgb.view(24, 2, 32, 2, 3).double().mean((1, 3)).reshape(-1, 3)
    assert (found.rgb - mean).abs().max() < 1.01  # rounded in each direction
    assert (found.grey - found.rgb.double() @ torch.tensor([0.299, 0.587, 0.114], dtype=torch.float64)).abs().max() < 1e-3


def test_a_pixel_counts_if_all_of_its_area_does(capture):
    mask = torch.ones(48, 64)
    mask[0, 5] = 0.5
    mask[10:20] = 0.0
    found = reduce_pictures(Shown(capture, {1: Frame(torch.full((48, 64, 3), 200, dtype=torch.uint8), mask)}), 32).grey.view(24, 32)
    out = torch.zeros(24, 32, dtype=torch.bool)
    out[0, 2] = True
    out[5:10] = True
    assert ((found == UNCOUNTED) == out).all() and (found[~out] - 200).abs().max() < 1e-3


def test_cameras_fit_the_reduced_pictures(capture):
    found = reduce_pictures(capture, 40)
    assert found.size.tolist() == [[40, 30]] * len(capture.train) and len(found) == 7
    camera: Camera = capture.views[capture.train[2]].camera
    xyz = np.random.default_rng(0).uniform((-1, -1, 1), (1, 1, 2), (50, 3)) + found.centres[2]
    local, shown = found.project(2, xyz)
    wanted = xyz @ camera.world_to_cam[:3, :3].double().numpy().T + camera.world_to_cam[:3, 3].double().numpy()
    assert np.allclose(local, wanted) and np.allclose(found.centres[2], camera.position.numpy(), atol=1e-5)
    u, v = (camera.fx * local[:, 0] / local[:, 2] + camera.cx) * 40 / 64, (camera.fy * local[:, 1] / local[:, 2] + camera.cy) * 30 / 48
    assert (shown == ((u >= 0) & (u < 40) & (v >= 0) & (v < 30))).all() and shown.any() and not shown.all()


def test_pixels_return_from_the_world(capture):
    found = reduce_pictures(capture, 40)
    pixels = np.arange(0, 1200, 7)
    local, shown = found.project(3, found.unproject(3, pixels, np.full(len(pixels), 2.5)))
    c = found.cameras[3].numpy()
    u, v = c[12] * local[:, 0] / local[:, 2] + c[14], c[13] * local[:, 1] / local[:, 2] + c[15]
    assert shown.all() and np.allclose(local[:, 2], 2.5) and np.allclose(u, pixels % 40 + 0.5) and np.allclose(v, pixels // 40 + 0.5)


def test_points_behind_a_camera_are_not_shown(capture):
    found = reduce_pictures(capture, 40)
    behind = found.unproject(0, np.array([610, 620]), np.array([-1.0, -2.0]))
    assert not found.project(0, behind)[1].any()


def test_small_pictures_stay_as_they_are_and_narrow_ones_keep_a_side(capture):
    assert reduce_pictures(capture, 1000).size.tolist() == [[64, 48]] * 7
    view = replace(capture.views[1], camera=replace(capture.views[1].camera, width=400, height=20))
    narrow = Shown(capture, {1: Frame(torch.zeros(20, 400, 3, dtype=torch.uint8), None)})
    narrow.views = (capture.views[0], view)
    assert reduce_pictures(narrow, 100).size.tolist() == [[320, 16]]


def test_the_pixels_of_points_are_found(capture):
    found = reduce_pictures(capture, 40)
    pixels = np.arange(0, 1200, 11)
    xyz = np.concatenate((found.unproject(1, pixels, np.full(len(pixels), 3.0)), found.unproject(1, pixels[:5], np.full(5, -3.0))))
    again, depth = found.find_pixels(1, xyz)
    assert (again == pixels).all() and np.allclose(depth, 3.0)
