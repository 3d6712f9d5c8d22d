"""Points far away where photographs show none of the capture's points."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from scene_experts.core.types import Points
from scene_experts.data.far import CELLS, FARTHEST, OUTSIDE, PART, REACH, add_far_points, find_holes
from scene_experts.data.views import Frame
from support.captures import load
from support.synthetic import make_capture

SIZE = (100, 60)


@pytest.fixture(scope="module")
def capture(tmp_path_factory):
    return load(make_capture(tmp_path_factory.mktemp("capture"), views=9, size=SIZE, points=300, mixed_sizes=False).folder)


def half_seen(capture, view=0):
    """Return the capture with those of its points only that a view shows in its left third."""
    camera = capture.views[view].camera
    x, _, z = (capture.points.xyz.double() @ camera.world_to_cam[:3, :3].double().T + camera.world_to_cam[:3, 3].double()).T
    left = (z > 0) & (camera.fx * x / z + camera.cx < camera.width / 3)
    return replace(capture, points=Points(capture.points.xyz[left], capture.points.rgb[left]), train=(view,))


def holes_by_hand(view, xyz):
    camera, edge = view.camera, SIZE[0] / CELLS
    rows, columns = round(SIZE[1] / edge), CELLS
    hole, depths = np.ones((rows, columns), bool), []
    for point in xyz:
        x, y, z = camera.world_to_cam.double().numpy()[:3] @ [*point, 1]
        u, v = camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy
        if z > 0 and 0 <= u < SIZE[0] and 0 <= v < SIZE[1]:
            depths.append(z)
            row, column = int(v / edge), int(u / edge)
            hole[max(0, row - REACH) : row + REACH + 1, max(0, column - REACH) : column + REACH + 1] = False
    return hole, float(np.quantile(depths, FARTHEST))


def test_holes_by_hand(capture):
    some = half_seen(capture)
    xyz = some.points.xyz.double().numpy()
    hole, depth = find_holes(some.views[0], torch.from_numpy(xyz))
    expected, farthest = holes_by_hand(some.views[0], xyz)
    assert np.array_equal(hole, expected) and hole.any() and not hole.all() and depth == pytest.approx(farthest)
    assert find_holes(some.views[0], torch.from_numpy(xyz[:5]))[1] is None


def test_points_lie_in_the_holes_at_their_depth_with_their_colours(capture):
    some = half_seen(capture)
    hole, depth = find_holes(some.views[0], some.points.xyz)
    found = add_far_points(some, 5.0)
    own, camera = len(some.points.xyz), some.views[0].camera
    assert torch.equal(found.points.xyz[:own], some.points.xyz) and torch.equal(found.points.rgb[:own], some.points.rgb)
    assert (
        len(found.points.xyz) == own + found.added and 0 < found.added <= max(1, PART * own) and found.share == pytest.approx(hole.mean())
    )
    x, y, z = (found.points.xyz[own:].double() @ camera.world_to_cam[:3, :3].double().T + camera.world_to_cam[:3, 3].double()).T
    torch.testing.assert_close(z, torch.full_like(z, 5 * depth), rtol=0.02, atol=0)
    column, row = ((camera.fx * x / z + camera.cx) / (SIZE[0] / CELLS)).long(), ((camera.fy * y / z + camera.cy) / (SIZE[0] / CELLS)).long()
    assert hole[row, column].mean() > 0.9  # those of several cells lie between them
    assert "points far away, for the" in found.describe()
    low, high = np.quantile(some.points.xyz.double().numpy(), (OUTSIDE, 1 - OUTSIDE), axis=0)
    room = (high - low).max()
    np.testing.assert_allclose(found.box, [*(low - room), *(high + room)], rtol=1e-3)


def test_every_hole_has_its_point_where_there_is_room(capture, monkeypatch):
    monkeypatch.setattr("scene_experts.data.far.PART", 10.0)
    monkeypatch.setattr("scene_experts.data.far.fuse", lambda cloud, edge: cloud)
    some = half_seen(capture)
    hole, _ = find_holes(some.views[0], some.points.xyz)
    found = add_far_points(some, 5.0)
    assert found.added == hole.sum()
    rgb = some.frame(0).rgb.numpy().astype(float).reshape(hole.shape[0], 4, CELLS, 4, 3).mean((1, 3))
    assert np.abs(found.points.rgb[-found.added :].numpy() - rgb[hole]).max() <= 1
    mask = torch.zeros(SIZE[1], SIZE[0])
    mask[:, 60:] = 1
    pixels = some.frame(0).rgb
    monkeypatch.setattr(type(some), "frame", lambda self, index: Frame(pixels, mask))
    assert add_far_points(some, 5.0).added == hole[:, 15:].sum()


def test_nothing_is_added_where_points_are_everywhere_or_there_are_none(capture):
    assert add_far_points(replace(capture, points=None), 5.0) is None
    every = [(u, v) for u in np.arange(2, SIZE[0], 4) for v in np.arange(2, SIZE[1], 4)]
    camera = capture.views[0].camera
    local = torch.tensor([[(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, 1.0] for u, v in every], dtype=torch.float64)
    xyz = (local - camera.world_to_cam[:3, 3].double()) @ camera.world_to_cam[:3, :3].double()
    full = replace(capture, points=Points(xyz, torch.zeros(len(xyz), 3, dtype=torch.uint8)), train=(0,))
    assert add_far_points(full, 5.0) is None
