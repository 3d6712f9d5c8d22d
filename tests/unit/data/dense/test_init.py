"""The dense start of a capture: points on its surfaces, from the training photographs alone."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from PIL import Image
from scipy.spatial import KDTree

from scene_experts.core.errors import InputError
from scene_experts.core.types import Points
from scene_experts.data.dense import SizedPoints, choose_number, find_uncovered, start_densely, surface_points, sweep_views
from scene_experts.native import library as native
from support.captures import load
from support.planes import hole, make_planes, plane
from support.synthetic import make_capture
from support.synthetic import surface_points as surface_points_of_the_scene

pytestmark = pytest.mark.skipif(native.load() is None, reason="no compiled library")


def opened(folder, **data):
    return load(folder, normalise="none", split="mod8", **data)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return make_planes(tmp_path_factory.mktemp("planes") / "capture", plane(4.0))


@pytest.fixture(scope="module")
def capture(folder):
    capture = opened(folder)
    yield capture
    capture.images.close()


def test_points_lie_on_the_surface_and_have_the_colours_of_the_photographs(capture):
    found = start_densely(capture)
    xyz, rgb = found.points.xyz, found.points.rgb.int()
    assert xyz.dtype == torch.float64 and found.points.rgb.dtype == torch.uint8 and found.views == len(capture.train)
    near = ((xyz[:, 2] - 4).abs() < 0.1).double().mean()
    assert near > 0.8 and 1000 < len(xyz) < 7 * 64 * 48
    new = rgb[found.kept :]
    assert (new[:, 0] + new[:, 2] - 255).abs().max() <= 3 and new[:, 0].double().std() > 20  # blue is 255 - red in these pictures
    assert f"{len(xyz):,} points by a plane sweep over 7 views" in found.describe()


def test_held_out_photographs_change_nothing(folder, tmp_path):
    other = tmp_path / "other"
    other.mkdir()
    (other / "sparse").symlink_to(folder / "sparse")
    (other / "images").mkdir()
    found = []
    for place, path in enumerate(sorted((folder / "images").iterdir())):
        pixels = np.asarray(Image.open(path))
        Image.fromarray(255 - pixels[::-1] if place % 8 == 0 else pixels).save(other / "images" / path.name)
    for where in (folder, other):
        capture = opened(where)
        assert capture.test == (0, 8)
        found.append(start_densely(capture))
        capture.images.close()
    assert torch.equal(found[0].points.xyz, found[1].points.xyz) and torch.equal(found[0].points.rgb, found[1].points.rgb)


def test_the_number_of_threads_changes_nothing(capture):
    before, found = torch.get_num_threads(), []
    for threads in (1, 3):
        torch.set_num_threads(threads)
        found.append(start_densely(capture).points)
    torch.set_num_threads(before)
    assert torch.equal(found[0].xyz, found[1].xyz) and torch.equal(found[0].rgb, found[1].rgb)


def test_holes_get_far_points_and_no_fog(tmp_path):
    capture = opened(make_planes(tmp_path / "capture", hole(3.0, 0.7, 15.0), points=600))
    found = start_densely(capture)
    capture.images.close()
    z = found.points.xyz[:, 2]
    assert 0.05 < found.holes < 0.9 and ((z[found.kept :] > 13).sum() > 30) and (z[: found.kept] > 14).sum() > 30
    assert (z > 2.8).all() and (((z - 3).abs() < 0.2) | (z > 13)).double().mean() > 0.99  # hardly anything stands between the two


def test_what_a_mask_leaves_out_gives_no_points(folder, tmp_path):
    other = tmp_path / "masked"
    other.mkdir()
    for name in ("sparse", "images"):
        (other / name).symlink_to(folder / name)
    (other / "masks").mkdir()
    mask = np.full((48, 64), 255, dtype=np.uint8)
    mask[:, 32:] = 0
    for path in (folder / "images").iterdir():
        Image.fromarray(mask).save(other / "masks" / path.name)
    capture = opened(other)
    found = start_densely(replace(capture, points=Points(capture.points.xyz, torch.zeros_like(capture.points.rgb))))
    fresh = found.points.xyz[found.kept :].float()
    shown = torch.zeros(len(fresh), dtype=torch.bool)
    for index in capture.train:
        camera = capture.views[index].camera
        local = fresh @ camera.world_to_cam[:3, :3].T + camera.world_to_cam[:3, 3]
        shown |= (local[:, 2] > 0) & (camera.fx * local[:, 0] / local[:, 2] + camera.cx < 33)
    capture.images.close()
    assert len(fresh) > 50 and shown.all()


def test_of_many_pixels_every_nth_is_taken(capture):
    own = SizedPoints.of(capture.points.xyz.numpy(), capture.points.rgb.numpy())
    maps = sweep_views(capture, own)
    every = len(surface_points(maps, 10**9))
    assert every > 3000 and 0.4 < len(surface_points(maps, every // 2)) / every < 0.6


def test_the_number_follows_the_points_and_the_limit(capture):
    assert choose_number(10, 0) == 13_000 and choose_number(50_000, 0) == 50_000
    assert choose_number(50_000, 100) == 80 and choose_number(10, 10**6) == 13_000 and choose_number(10, 1) == 1
    assert len(start_densely(capture, 100).points.xyz) <= 80


def test_points_far_from_the_surface_are_uncovered():
    size = np.array([0.1, 0.1])
    surface = SizedPoints(np.array([[0.0, 0, 0], [1, 0, 0]]), np.zeros((2, 3)), size, np.ones(2))
    own = SizedPoints.of(np.array([[0.15, 0, 0], [0.5, 0, 0], [1, 0.25, 0]]), np.zeros((3, 3), dtype=np.uint8))
    assert find_uncovered(own, surface, 2.0).tolist() == [False, True, True]
    assert find_uncovered(own, surface.pick(np.zeros(2, dtype=bool)), 2.0).all()


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda c: replace(c, points=None), "expected 3D points"),
        (lambda c: replace(c, train=c.train[:2]), "expected at least 3 training views"),
        (lambda c: replace(c, points=Points(c.points.xyz * torch.tensor([1.0, 1, -1]), c.points.rgb)), "overlap with two others"),
    ],
)
def test_captures_without_depth_are_refused(capture, change, words):
    with pytest.raises(InputError, match=words):
        start_densely(change(capture))


def test_photographs_without_texture_are_refused(tmp_path):
    capture = opened(make_planes(tmp_path / "grey", hole(3.0, 50.0, 4.0)))
    with pytest.raises(InputError, match=r"expected photographs that show depth for --init dense, found it in 0\.0 % of their pixels"):
        start_densely(capture)
    capture.images.close()


@pytest.mark.slow
def test_pictures_of_several_sizes_and_lenses_are_swept(tmp_path):
    made = make_capture(tmp_path / "capture", views=16, size=(144, 96))
    capture = opened(made.folder)
    found = start_densely(capture)
    fresh = found.points.xyz[found.kept :].numpy()
    assert len({view.camera.width for view in capture.views}) == 3 and found.views == 14 and len(fresh) > 300
    tree = KDTree(surface_points_of_the_scene(40_000, np.random.default_rng(0)))
    assert np.median(tree.query(fresh)[0]) < 0.15  # of a scene of four units
    capture.images.close()
