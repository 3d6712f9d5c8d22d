"""Bundle adjustment: made views, whose true poses are known."""

import numpy as np
import pytest
from scipy.optimize import least_squares

from scene_experts.geometry.bundle import Observations, _loss, _System, adjust, find_errors, move

VIEWS, POINTS = 6, 40


def made(seed=0, noise=0.0):
    """Cameras on an arc that look at points around the origin, and what they see."""
    rng = np.random.default_rng(seed)
    points = rng.normal(size=(POINTS, 3)) * 0.6
    poses = np.tile(np.eye(4), (VIEWS, 1, 1))
    poses[:, :3, 3] = [0, 0, 4]
    turns = np.zeros((VIEWS, 6))
    turns[:, 1] = np.linspace(-0.6, 0.6, VIEWS)
    poses = poses @ move(np.tile(np.eye(4), (VIEWS, 1, 1)), turns)
    view, point = (part.ravel() for part in np.meshgrid(np.arange(VIEWS), np.arange(POINTS), indexing="ij"))
    kept = rng.random(len(view)) < 0.7
    seen = Observations(view[kept], point[kept], np.zeros((int(kept.sum()), 2)), np.full((int(kept.sum()), 2), 500.0))
    uv = find_errors(poses, points, seen) / seen.focal + rng.normal(size=seen.uv.shape) * noise / 500
    return poses, points, Observations(seen.view, seen.point, uv, seen.focal), rng


def disturbed(poses, points, rng, size=0.005):
    return move(poses, rng.normal(size=(VIEWS, 6)) * size), points + rng.normal(size=points.shape) * size


def turn_between(poses, true):
    """The largest angle between the relative rotations of the first view and the others, and the true ones."""
    relative = [p[0, :3, :3] @ np.swapaxes(p[:, :3, :3], 1, 2) for p in (poses, true)]  # whatever turns the world
    between = np.swapaxes(relative[0], 1, 2) @ relative[1]
    return np.linalg.norm(between - np.eye(3), axis=(1, 2)).max()


def test_disturbed_poses_and_points_are_found_again():
    poses, points, seen, rng = made()
    found = adjust(*disturbed(poses, points, rng), seen)
    assert found.before > 1 and found.after < 1e-6
    assert turn_between(found.poses, poses) < 1e-7
    assert found.observations == len(seen)


def test_wrong_observations_hardly_count(monkeypatch):
    poses, points, seen, rng = made(noise=0.3)
    wrong = rng.random(len(seen)) < 0.05
    uv = seen.uv + wrong[:, None] * rng.normal(size=seen.uv.shape) * 0.2  # 100 px
    start = disturbed(poses, points, rng)
    given = Observations(seen.view, seen.point, uv, seen.focal)
    error = lambda seen: turn_between(adjust(*start, seen).poses, poses)  # noqa: E731
    robust, without = error(given), error(given.only(~wrong))
    monkeypatch.setattr("scene_experts.geometry.bundle.ROBUST", 1e9)
    assert robust < 2 * without
    assert robust < error(given) / 5


def test_the_gradient_is_that_of_differences():
    poses, points, seen, rng = made()
    poses, points = disturbed(poses, points, rng, 0.02)
    limit, h = 4.0, 1e-6  # some errors are beyond the limit
    system = _System(poses, points, seen, limit)
    motion, shift = rng.normal(size=(VIEWS, 6)), rng.normal(size=points.shape)
    loss = lambda s: _loss(move(poses, s * motion), points + s * shift, seen, limit)  # noqa: E731
    slope = (loss(h) - loss(-h)) / (2 * h)
    assert -slope == pytest.approx((system.g * motion).sum() + (system.h * shift).sum(), rel=1e-5)


def test_a_step_solves_the_whole_system():
    """The reduced system gives the step of the dense one, without the elimination of points."""
    poses, points, seen, rng = made()
    poses, points = disturbed(poses, points, rng)
    system, damping = _System(poses, points, seen, 1e9), 1e-3
    n = 6 * VIEWS
    H = np.zeros((n + 3 * POINTS, n + 3 * POINTS))
    for v in range(VIEWS):
        H[6 * v : 6 * v + 6, 6 * v : 6 * v + 6] = system.U[v]
    for p in range(POINTS):
        H[n + 3 * p : n + 3 * p + 3, n + 3 * p : n + 3 * p + 3] = system.V[p]
    for v, p, w in zip(seen.view, seen.point, system.W):
        H[6 * v : 6 * v + 6, n + 3 * p : n + 3 * p + 3] += w
        H[n + 3 * p : n + 3 * p + 3, 6 * v : 6 * v + 6] += w.T
    H += damping * np.diag(np.diag(H))
    whole = np.linalg.solve(H, np.concatenate([system.g.ravel(), system.h.ravel()]))
    new_poses, new_points = system.step(damping)
    np.testing.assert_allclose(new_points - points, whole[n:].reshape(-1, 3), atol=1e-6)
    np.testing.assert_allclose(new_poses, move(poses, whole[:n].reshape(-1, 6)), atol=1e-6)


def test_the_loss_is_that_of_a_library():
    poses, points, seen, rng = made(noise=0.5)
    poses, points = disturbed(poses, points, rng)
    found = adjust(poses, points, seen)

    def errors(x):
        return find_errors(move(poses, x[: 6 * VIEWS].reshape(-1, 6)), points + x[6 * VIEWS :].reshape(-1, 3), seen).ravel()

    best = least_squares(errors, np.zeros(6 * VIEWS + 3 * POINTS), x_scale="jac", max_nfev=60)
    ours = (find_errors(found.poses, found.points, seen) ** 2).sum() / 2
    assert ours == pytest.approx(best.cost, rel=1e-3)


def test_what_is_not_seen_twice_stays():
    poses, points, seen, rng = made()
    seen = seen.only(seen.view != 2)
    seen = seen.only((seen.point != 0) | (np.cumsum(seen.point == 0) == 1))
    start = disturbed(poses, points, rng)
    found = adjust(*start, seen)
    np.testing.assert_array_equal(found.points[0], start[1][0])
    np.testing.assert_allclose(found.poses[2], start[0][2], atol=1e-12)


def test_points_behind_their_camera_do_not_count():
    poses, points, seen, _ = made()
    points[0] = (0, 0, -40)
    found = adjust(poses, points, seen)
    assert found.observations < len(seen)
    np.testing.assert_array_equal(found.points[0], points[0])


def test_without_observations_nothing_moves():
    poses, points, seen, _ = made()
    found = adjust(poses, points, seen.only(np.zeros(len(seen), bool)))
    assert found.observations == 0 and np.isnan(found.before)
    np.testing.assert_array_equal(found.poses, poses)
