"""The plane sweep finds known depths, and equals a slow reference in numpy. So do the comparisons with the depths of other views."""

import ctypes

import numpy as np
import pytest
import torch
from numpy.lib.stride_tricks import sliding_window_view

from scene_experts.data.dense.sweep import AGREEMENT, CONFIRMED, STRONG, WEAK, DepthMaps
from scene_experts.native import library as native
from support.planes import hole, neighbours, plane, poses, reduced, step

pytestmark = pytest.mark.skipif(native.load() is None, reason="no compiled library")
PLANES = 24


def swept(shape, near=2.5, far=8.0, views=5, planes=PLANES, **size):
    pictures, depths = reduced(shape, poses(views), **size)
    return DepthMaps(pictures, neighbours(views, near, far), planes), depths


def depth_of(maps, view):
    width, height = maps.pictures.size[view].tolist()
    inverse = maps.inverse[maps.pictures.start[view] : maps.pictures.start[view + 1]].double().numpy().reshape(height, width)
    return np.divide(1, inverse, out=np.zeros_like(inverse), where=inverse > 0)


def windows(picture):
    """The 49 pixels around each, [H, W, 49]; nan beyond the border."""
    return sliding_window_view(np.pad(picture, 3, constant_values=np.nan), (7, 7)).reshape(*picture.shape, 49)


def look_up(picture, u, v):
    """Bilinear values at pixel coordinates (u, v), where centres are at halves; nan outside of the centres."""
    height, width = picture.shape
    x, y = u - 0.5, v - 0.5
    inside = (x >= 0) & (y >= 0) & (x <= width - 1) & (y <= height - 1)
    i, j = (np.clip(np.floor(np.where(inside, c, 0)), 0, n - 2).astype(int) for c, n in ((x, width), (y, height)))
    a, b = x - i, y - j
    value = (1 - b) * ((1 - a) * picture[j, i] + a * picture[j, i + 1]) + b * ((1 - a) * picture[j + 1, i] + a * picture[j + 1, i + 1])
    return np.where(inside, value, np.nan)


def zncc(g, w):
    """ZNCC of windows [H, W, 49] with variances of at least 4; -1 where a window is cut."""
    mean = lambda values: values.sum(-1) / 49  # noqa: E731
    covariance = mean(g * w) - mean(g) * mean(w)
    variance = lambda values: np.maximum(mean(values * values) - mean(values) ** 2, 0) + 4  # noqa: E731
    return np.nan_to_num(covariance / np.sqrt(variance(g) * variance(w)), nan=-1.0)


def sweep_slowly(pictures, pairs, planes, view):
    """Inverse depths and scores [H, W] of a view, pixel by pixel and plane by plane, through world points and no homography."""
    picture = lambda v: pictures.grey[pictures.start[v] : pictures.start[v + 1]].double().numpy().reshape(*pictures.size[v].tolist()[::-1])  # noqa: E731
    mine = picture(view)
    first, last = pairs.planes[view].tolist()
    values = np.linspace(first, last, planes)
    scores = []
    for value in values:
        xyz = pictures.unproject(view, np.arange(mine.size), np.full(mine.size, 1 / value))
        found = []
        for other in pairs.compared[view].tolist():
            if other < 0:
                continue
            local, c = pictures.project(other, xyz)[0], pictures.cameras[other].numpy()
            at = look_up(picture(other), c[12] * local[:, 0] / local[:, 2] + c[14], c[13] * local[:, 1] / local[:, 2] + c[15])
            found.append(zncc(windows(mine), windows(at.reshape(mine.shape))))
        scores.append(np.sort(found, 0)[-2:].mean(0))
    scores = np.array(scores)
    best = scores.argmax(0)
    rows, columns = np.indices(best.shape)
    inner = np.clip(best, 1, planes - 2)
    left, middle, right = (scores[inner + d, rows, columns] for d in (-1, 0, 1))
    bend = left - 2 * middle + right
    offset = np.clip(np.divide(0.5 * (left - right), bend, out=np.zeros_like(bend), where=bend < -1e-6), -0.5, 0.5)
    spread = np.nan_to_num(np.nanvar(windows(mine), -1)) >= 9
    known = (best == inner) & spread & ~np.isnan(windows(mine)).any(-1)
    return np.where(known, first + (inner + offset) * (values[1] - values[0]), 0), np.where(known, middle, -1)


def test_the_sweep_is_that_of_the_slow_reference():
    maps, _ = swept(step(3.0, 5.0), size=(24, 20), focal=24.0, planes=10)
    for view in (0, 2):
        inverse, score = sweep_slowly(maps.pictures, maps.pairs, 10, view)
        part = slice(*maps.pictures.start[view : view + 2].tolist())
        found, rated = (part_of[part].double().numpy().reshape(inverse.shape) for part_of in (maps.inverse, maps.score))
        assert (inverse > 0).mean() > 0.3 and np.abs(rated - score).max() < 1e-3
        assert ((found > 0) == (inverse > 0)).all() and np.mean(np.abs(found - inverse) < 1e-4) > 0.99


@pytest.mark.parametrize("depth", [3.0, 4.4, 7.0])
def test_a_plane_is_found_at_its_depth(depth):
    maps, depths = swept(plane(depth))
    maps.keep_confirmed()
    for view, true in enumerate(depths):
        found = depth_of(maps, view)
        known = found > 0
        assert known.mean() > 0.35
        error = np.abs(found[known] / true[known] - 1)
        assert np.median(error) < 0.005 and np.quantile(error, 0.95) < 0.02


def test_both_sides_of_a_step_are_found():
    maps, depths = swept(step(3.0, 5.5), size=(64, 48), focal=64.0)
    maps.keep_confirmed()
    found, true = depth_of(maps, 2), depths[2]
    for side in (3.0, 5.5):
        here = (np.abs(true - side) < 0.3) & (found > 0)
        assert here.sum() > 0.15 * true.size and np.mean(np.abs(found[here] / true[here] - 1) < 0.02) > 0.9


def test_a_hole_without_texture_has_no_depth():
    maps, depths = swept(hole(4.0, 0.8, 20.0), size=(64, 48), focal=64.0)
    maps.keep_confirmed()
    found, true = depth_of(maps, 2), depths[2]
    inside = sliding_window_view(np.pad(true > 10, 4), (9, 9)).all((2, 3))  # without the blurred rim
    assert inside.sum() > 100 and not (found[inside] > 0).any() and (found > 0).sum() > 500


def test_pixels_that_do_not_count_have_no_depth_and_give_none():
    pictures, _ = reduced(plane(4.0), poses(5))
    wide = pictures.grey.view(5, 36, 48)
    wide[2, :, 30:] = -1000.0
    wide[3] = -1000.0
    maps = DepthMaps(pictures, neighbours(5, 2.5, 8.0), PLANES)
    inverse = maps.inverse.view(5, 36, 48)
    assert not inverse[3].any() and not inverse[2, :, 27:].any() and inverse[2, 3:-3, 3:27].count_nonzero() > 200


def test_a_view_without_planes_is_left_out():
    pictures, _ = reduced(plane(4.0), poses(4))
    pairs = neighbours(4, 2.5, 8.0)
    pairs.planes[1] = 0
    maps = DepthMaps(pictures, pairs, PLANES)
    assert not maps.inverse[pictures.start[1] : pictures.start[2]].any() and maps.inverse[: pictures.start[1]].any()
    assert 1 not in pairs.partners()[1].tolist()


def test_every_number_of_threads_and_instruction_set_gives_the_same_bits():
    pictures, _ = reduced(step(3.0, 5.0), poses(5))
    pairs, found, before = neighbours(5, 2.5, 8.0), [], torch.get_num_threads()
    for threads in (1, 2, 3):
        torch.set_num_threads(threads)
        maps = DepthMaps(pictures, pairs, PLANES)
        found.append((maps.inverse, maps.score))
    torch.set_num_threads(before)
    for level in native.list_levels():
        if native.find(level):
            library, maps = native.require(level), DepthMaps(pictures, pairs, PLANES)
            assert library.se_sweep_match(ctypes.byref(maps._call())) == 0
            found.append((maps.inverse, maps.score))
    assert all(torch.equal(a, b) for pair in found[1:] for a, b in zip(found[0], pair))


def test_confirmed_depths_are_those_that_two_views_find_again():
    maps, _ = swept(step(3.0, 5.0), size=(24, 20), focal=24.0, planes=10)
    inverse, score, start = maps.inverse.double().numpy(), maps.score.numpy(), maps.pictures.start.tolist()
    first, others = maps.pairs.partners()
    wanted = np.zeros(len(inverse), dtype=bool)
    for view in range(len(maps.pictures)):
        for pixel in range(start[view + 1] - start[view]):
            at = start[view] + pixel
            if not score[at] > np.float32(STRONG):
                continue
            xyz = maps.pictures.unproject(view, np.array([pixel]), 1 / inverse[[at]])
            count = 0
            for other in others[first[view] : first[view + 1]].tolist():
                place, local = pixel_of(maps.pictures, other, xyz)
                if place is not None and score[start[other] + place] > np.float32(WEAK):
                    count += abs(1 / (inverse[start[other] + place] * local[2]) - 1) < AGREEMENT
            wanted[at] = count >= CONFIRMED
    maps.keep_confirmed()
    assert wanted.sum() > 300 and ((maps.inverse > 0).numpy() == wanted).all()


def pixel_of(pictures, view, xyz):
    """The pixel that shows a point [1, 3], or None, and its camera coordinates."""
    (local,), (shown,) = pictures.project(view, xyz)
    c, width = pictures.cameras[view].numpy(), int(pictures.size[view, 0])
    if not shown:
        return None, local
    return int(c[13] * local[1] / local[2] + c[15]) * width + int(c[12] * local[0] / local[2] + c[14]), local


def test_points_are_compared_with_every_view():
    maps, _ = swept(plane(4.0), size=(24, 20), focal=24.0, planes=10)
    maps.keep_confirmed()
    xyz = np.random.default_rng(0).uniform((-1.5, -1.5, 2.0), (1.5, 1.5, 6.0), (300, 3))
    xyz[:60, 2] = 4.0
    before, on = maps.compare(xyz, 0.04, 0.02)
    for i in range(len(xyz)):
        ratios = []
        for view in range(5):
            place, local = pixel_of(maps.pictures, view, xyz[[i]])
            if place is not None and (inverse := float(maps.inverse[maps.pictures.start[view] + place])) > 0:
                ratios.append(local[2] * inverse)
        assert before[i] == sum(r < 0.96 for r in ratios) and on[i] == sum(abs(r - 1) < 0.02 for r in ratios)
    assert before[xyz[:, 2] < 3.5].any() and on[:60].sum() > 100 and not before[xyz[:, 2] > 4.1].any()


def test_no_points_are_compared_with_nothing():
    maps, _ = swept(plane(4.0), size=(24, 20), focal=24.0, planes=10)
    assert [len(part) for part in maps.compare(np.zeros((0, 3)), 0.04)] == [0, 0]
