"""The preparation of captures: each step against its definition, and none changes its argument."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from scene_experts.core.errors import InputError
from scene_experts.core.types import Points
from scene_experts.data import prepare
from scene_experts.data.capture import Capture
from support.captures import load
from support.synthetic import make_capture


@pytest.fixture(scope="module")
def capture(tmp_path_factory: pytest.TempPathFactory) -> Capture:
    folder = tmp_path_factory.mktemp("synthetic")
    make_capture(folder, views=10, size=(48, 32), points=300)
    return load(folder, split="none", normalise="none")


def same(a: Capture, b: Capture) -> bool:
    """Return whether two captures are equal apart from the cached frames."""
    return (
        [(v.name, v.path, v.camera.id, v.camera.width) for v in a.views] == [(v.name, v.path, v.camera.id, v.camera.width) for v in b.views]
        and all(torch.equal(v.camera.world_to_cam, w.camera.world_to_cam) for v, w in zip(a.views, b.views))
        and (a.train, a.test, a.world, a.extent) == (b.train, b.test, b.world, b.extent)
    )


def test_splits(capture: Capture) -> None:
    ten = range(10)
    for split, test in (("mod8", (0, 8)), ("mod:5", (0, 5)), ("first:3", (0, 1, 2)), ("fold:2/5", (1, 6)), ("none", ())):
        out = prepare.hold_out(capture, split)
        assert out.test == test and out.train == tuple(i for i in ten if i not in test)
    assert prepare.hold_out(capture, "mod:5").split == "mod5"


@pytest.mark.parametrize(
    "split", ["mod1", "modx", "first:0", "fold:0/5", "fold:6/5", "fold:11/40", "fold:1/1", "half", "files", "", "mod²", "first:²"]
)
def test_bad_splits(capture: Capture, split: str) -> None:
    with pytest.raises(InputError, match="--split"):
        prepare.hold_out(capture, split)


def test_selecting_views_renumbers_them_and_keeps_the_split(capture: Capture) -> None:
    held = prepare.hold_out(capture, "mod5")
    out = prepare.select_views(held, [7, 5, 2, 7])
    assert [v.name for v in out.views] == ["view_002.png", "view_005.png", "view_007.png"]
    assert [v.camera.id for v in out.views] == [0, 1, 2] and out.train == (0, 2) and out.test == (1,)
    assert torch.equal(out.frame(1).rgb, capture.frame(5).rgb)
    assert [v.name for v in prepare.limit_views(capture, 5).views] == [f"view_{i:03d}.png" for i in (0, 2, 4, 6, 8)]
    assert prepare.limit_views(capture, 99) is capture
    with pytest.raises(InputError, match="--max-views"):
        prepare.limit_views(capture, 0)


def test_downscale_keeps_rays(capture: Capture) -> None:
    out = prepare.downscale(capture, "factor:3")
    for before, after in zip(capture.views, out.views):
        a, b = before.camera, after.camera
        assert (b.width, b.height) == (round(a.width / 3), round(a.height / 3))
        for share in (0.0, 0.25, 1.0):  # the same fraction of the image belongs to the same ray
            assert (share * a.width - a.cx) / a.fx == pytest.approx((share * b.width - b.cx) / b.fx, abs=1e-6)
            assert (share * a.height - a.cy) / a.fy == pytest.approx((share * b.height - b.cy) / b.fy, abs=1e-6)
        assert out.frame(b.id).rgb.shape == (b.height, b.width, 3)
    assert out.resolution == "factor:3" and capture.resolution == "cap1600"


def test_extent_is_that_of_3dgs(capture: Capture) -> None:
    held = prepare.measure_extent(prepare.hold_out(capture, "first:2"))
    eyes = np.stack(
        [-np.linalg.inv(v.camera.world_to_cam.double().numpy()[:3, :3]) @ v.camera.world_to_cam.numpy()[:3, 3] for v in held.views[2:]]
    )
    expected = 1.1 * np.linalg.norm(eyes - eyes.mean(0), axis=1).max()
    assert held.extent == pytest.approx(expected, rel=1e-5)
    assert held.views[0].camera.near == pytest.approx(min(0.2, 0.02 * expected))


def test_cameras_at_one_place_take_the_extent_from_the_points(capture: Capture) -> None:
    alone = prepare.select_views(capture, [3])
    eye = prepare.camera_centres(alone.views)[0]
    assert alone.points is not None
    assert prepare.camera_extent(alone) == pytest.approx(float((alone.points.xyz - eye).norm(dim=1).median()))
    assert prepare.camera_extent(replace(alone, points=None)) == 1.0
    noise = torch.full((3, 3), float("nan"), dtype=torch.float64)
    noisy = Points(torch.cat((noise, alone.points.xyz)), torch.cat((alone.points.rgb[:3], alone.points.rgb)))
    assert prepare.camera_extent(replace(alone, points=noisy)) == prepare.camera_extent(alone)
    assert prepare.camera_extent(replace(alone, points=Points(noise, alone.points.rgb[:3]))) == 1.0


def test_scaling_and_normalising(capture: Capture) -> None:
    before = prepare.measure_extent(capture)
    out = prepare.scale(before, 7.0)
    assert out.extent == pytest.approx(7 * before.extent) and out.world.scale == 7
    normal = prepare.normalise(out)
    assert normal.extent == 5.0 and normal.views[0].camera.near == pytest.approx(0.1)
    torch.testing.assert_close(prepare.camera_centres(normal.views).mean(0), torch.zeros(3, dtype=torch.float64), atol=1e-5, rtol=0)
    assert capture.points is not None and normal.points is not None
    torch.testing.assert_close(normal.world.to_input(normal.points.xyz), capture.points.xyz)
    for v, w in zip(capture.views, normal.views):
        torch.testing.assert_close(normal.world.camera_to_input(w.camera).world_to_cam, v.camera.world_to_cam, atol=1e-5, rtol=1e-5)


def test_far_and_infinite_points_are_dropped_and_counted(capture: Capture) -> None:
    before = prepare.measure_extent(capture)
    assert before.points is not None
    xyz = torch.cat((before.points.xyz, torch.tensor([[1e9, 0, 0], [0, float("nan"), 0], [0, 0, float("inf")]], dtype=torch.float64)))
    noisy = replace(before, points=Points(xyz, torch.zeros((len(xyz), 3), dtype=torch.uint8)))
    out = prepare.drop_outliers(noisy)
    assert out.points is not None and torch.equal(out.points.xyz, before.points.xyz)
    assert "3 of 303" in out.warnings[-1]
    assert noisy.points is not None and len(noisy.points.xyz) == 303
    assert prepare.drop_outliers(before) is before
    for factor in (1e-3, 1e3):  # the rule does not depend on the unit
        scaled = prepare.drop_outliers(prepare.scale(noisy, factor))
        assert scaled.points is not None and len(scaled.points.xyz) == 300


def test_mislocated_cameras_are_dropped_and_counted(capture: Capture) -> None:
    pose = capture.views[4].camera.world_to_cam.clone()
    pose[:3, 3] += 5000
    views = list(capture.views)
    views[4] = replace(views[4], camera=replace(views[4].camera, world_to_cam=pose))
    out = prepare.drop_outlier_views(replace(capture, views=tuple(views)))
    assert len(out.views) == 9 and "1 views" in out.warnings[-1] and "view_004.png" in out.warnings[-1]
    assert prepare.drop_outlier_views(capture) is capture


def test_random_points_are_seeded_and_around_the_subject(capture: Capture) -> None:
    before = prepare.measure_extent(capture)
    a, b, c = (prepare.add_random_points(before, 500, seed).points for seed in (0, 0, 1))
    assert a is not None and b is not None and c is not None
    assert torch.equal(a.xyz, b.xyz) and not torch.equal(a.xyz, c.xyz)
    assert a.xyz.dtype == torch.float64 and a.rgb.dtype == torch.uint8
    assert (a.xyz.amin(0) < torch.tensor([-1.0, -1.0, 0.0])).all() and (a.xyz.amax(0) > torch.tensor([1.0, 1.0, 1.0])).all()


def test_no_step_changes_its_argument(capture: Capture) -> None:
    before = replace(capture)
    for step in (
        lambda c: prepare.hold_out(c, "mod8"),
        lambda c: prepare.downscale(c, "factor:2"),
        lambda c: prepare.normalise(prepare.measure_extent(c)),
        lambda c: prepare.add_random_points(c),
        lambda c: prepare.select_views(c, [0, 1]),
        prepare.drop_outliers,
    ):
        step(capture)
        assert same(capture, before)


def test_focal_lengths_that_no_lens_has_are_told() -> None:
    assert not prepare.tell_stretched([]) and not prepare.tell_stretched([(500.0, 500.0), (800.0, 850.0)])
    assert "834 and 2,109 px" in prepare.tell_stretched([(500.0, 500.0), (834.2, 2109.0)])[0]
