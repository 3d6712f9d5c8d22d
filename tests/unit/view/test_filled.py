"""First views that fill a screen, of a wall that cameras in a row photograph."""

import math
from types import SimpleNamespace

import pytest
import torch

from scene_experts.core.types import Camera, Render
from scene_experts.view.filled import ASPECTS, SHOWN, Evidence, find_first_views, small

DEPTH = 4.0
WIDE, HIGH = 48, 36


def camera_at(x: float, y: float = 0.0, width: int = WIDE, height: int = HIGH) -> Camera:
    """A camera at (x, y, 0) that looks along z with a focal length of 48 px."""
    pose = torch.eye(4)
    pose[0, 3], pose[1, 3] = -x, -y
    return Camera(pose, torch.tensor([[48.0, 0, width / 2], [0, 48.0, height / 2], [0, 0, 1]]), width, height, 0.1)


def wall(half_width: float, half_height: float):
    """Draws a wall at DEPTH around the axis."""

    def draw(camera: Camera) -> Render:
        y, x = torch.meshgrid(torch.arange(camera.height) + 0.5, torch.arange(camera.width) + 0.5, indexing="ij")
        rays = torch.stack([(x - camera.cx) / camera.fx, (y - camera.cy) / camera.fy, torch.ones_like(x)], -1)
        along, place = rays @ camera.world_to_cam[:3, :3], camera.position
        z = (DEPTH - place[2]) / along[..., 2]
        hit = place + z[..., None] * along
        alpha = ((hit[..., 0].abs() <= half_width) & (hit[..., 1].abs() <= half_height) & (z > 0)).float()
        none = torch.zeros(0)
        return Render(torch.zeros(camera.height, camera.width, 3), alpha, z * alpha, none, none)

    return draw


def capture_of(*cameras: Camera):
    return SimpleNamespace(
        views=[SimpleNamespace(camera=c) for c in cameras], train=tuple(range(len(cameras))), test=(), points=None, extent=DEPTH
    )


ROW = [camera_at(x) for x in (-2.0, -1.0, 0.0, 1.0, 2.0)]


def test_points_are_counted_in_the_photographs_that_saw_them():
    """A photograph of the wall is 4 wide and 3 high; behind the wall nothing is seen."""
    evidence = Evidence.of(capture_of(*ROW), wall(10, 10))
    points = torch.tensor([[0.1, 0, 4], [0.1, 1.4, 4], [0.1, 1.6, 4], [2.5, 0, 4], [3.5, 0, 4], [4.5, 0, 4], [0, 0, 5], [0, 0, -1]])
    assert evidence.count(points).tolist() == [4, 4, 0, 2, 1, 0, 0, 0]
    assert Evidence.of(capture_of(*ROW), wall(10, 10), most=2).least == 2


def test_a_pixel_is_covered_where_it_is_opaque_and_three_saw_it():
    evidence, camera = Evidence.of(capture_of(*ROW), wall(1.0, 10)), camera_at(0.0, 1.0)
    found = evidence.covered(camera, wall(1.0, 10)(camera))
    y, x = torch.meshgrid(torch.arange(HIGH) + 0.5, torch.arange(WIDE) + 0.5, indexing="ij")
    hit_x, hit_y = (x - WIDE / 2) / 12, (y - HIGH / 2) / 12 + 1.0
    assert torch.equal(found, (hit_x.abs() <= 1.0) & (hit_y <= 1.5))


@pytest.mark.parametrize("size", [(WIDE, HIGH), (27, 48)], ids=["landscape", "portrait"])
def test_first_views_show_what_three_photographs_saw(size):
    """Three photographs of the wall saw what is within the width of one, less the way between the outermost."""
    cameras = [camera_at(x, 0.0, *size) for x in (-0.2, 0.0, 0.2)]
    half = torch.tensor([size[0] / 24 - 0.2, size[1] / 24])
    found = find_first_views(capture_of(*cameras), wall(10, 10))
    assert len(found) == len(ASPECTS)
    for aspect, first in zip(ASPECTS, found):
        camera = first.camera
        assert math.isclose(camera.width / camera.height, aspect, rel_tol=1e-3) and first.share >= 0.98
        picture = wall(100, 100)(camera)
        y, x = torch.meshgrid(torch.arange(camera.height) + 0.5, torch.arange(camera.width) + 0.5, indexing="ij")
        rays = torch.stack([(x - camera.cx) / camera.fx, (y - camera.cy) / camera.fy, torch.ones_like(x)], -1)
        hit = camera.position + picture.depth[..., None] * (rays @ camera.world_to_cam[:3, :3])
        assert float((hit[..., :2].abs() <= half).all(-1).double().mean()) >= 0.975, aspect
        assert max(camera.width / camera.fx * 48 / size[0], camera.height / camera.fy * 48 / size[1]) >= SHOWN - 1e-3


def test_a_lone_object_has_no_first_view():
    assert find_first_views(capture_of(*ROW), wall(0.5, 0.5)) == []
    assert find_first_views(capture_of(), wall(10, 10)) == []


def test_a_small_camera_has_the_view_of_the_large_one():
    large = camera_at(1.0, 0.0, 480, 360)
    found = small(large, 36)
    assert (found.width, found.height) == (48, 36)
    assert found.fx / 48 == pytest.approx(large.fx / 480) and found.cy / 36 == pytest.approx(large.cy / 360)
