"""Points are thinned to one in each cell, whose size follows that of a pixel."""

import numpy as np

from scene_experts.data.dense.cells import FINEST, SizedPoints, fuse, thin


def cloud(n=2000, seed=0, size=0.01):
    rng = np.random.default_rng(seed)
    return SizedPoints(rng.uniform(-1, 1, (n, 3)) * (1, 1, 0.001), rng.uniform(0, 255, (n, 3)), np.full(n, size), rng.uniform(0.5, 1, n))


def fuse_slowly(points, edge, least):
    cells = {}
    for i in range(len(points)):
        length = 2.0 ** np.floor(np.log2(points.size[i] * edge))
        cells.setdefault((length, *np.floor(points.xyz[i] / length)), []).append(i)
    kept = [rows for rows in cells.values() if len(rows) >= least]
    mean = lambda values, rows: np.average(values[rows], 0, points.weight[rows])  # noqa: E731
    return sorted(tuple(np.concatenate((mean(points.xyz, rows), mean(points.rgb, rows), [mean(points.size, rows)]))) for rows in kept)


def test_a_cell_has_the_weighted_mean_of_its_points():
    points = cloud()
    points.size[1000:] *= 3
    for edge, least in ((1.0, 1), (7.3, 1), (7.3, 3)):
        found = fuse(points, edge, least)
        rows = sorted(map(tuple, np.concatenate((found.xyz, found.rgb, found.size[:, None]), 1)))
        assert len(found) > 10 and np.allclose(rows, fuse_slowly(points, edge, least))
        assert least > 1 or np.isclose(found.weight.sum(), points.weight.sum())


def test_thinning_gives_nearly_the_wanted_number_and_never_more():
    points = cloud(20_000)
    for wanted in (50, 900, 3000):
        found, edge = thin(points, wanted)
        assert len(found) <= wanted and len(fuse(points, edge / 2.1)) > wanted and edge >= FINEST


def test_few_points_stay():
    points = cloud(30)
    assert len(thin(points, 100)[0]) == 30
    assert len(thin(points.pick(np.zeros(30, dtype=bool)), 100)[0]) == 0


def test_farther_points_are_spaced_more_widely():
    near, far = cloud(20_000), cloud(20_000, size=0.04)
    counts = [len(fuse(part, 4.0)) for part in (near, far)]
    assert 8 < counts[0] / counts[1] < 20


def test_clouds_are_joined_picked_and_spread():
    points = cloud(10)
    joined = SizedPoints.join([points, points.pick(np.arange(10) < 2)])
    assert len(joined) == 12 and (joined.xyz[10:] == points.xyz[:2]).all()
    assert (points.spread(3).xyz == points.xyz[[0, 4, 9]]).all() and len(points.spread(20)) == 10 and len(points.spread(0)) == 0
    assert SizedPoints.of(points.xyz, np.zeros((10, 3), dtype=np.uint8)).weight.sum() == 10
