"""Bundle adjustment: the poses and points that agree best with where photographs show the points.

The sum of Huber's loss of the reprojection errors in px is minimised by Levenberg-Marquardt steps.
The points are eliminated first (Schur complement), because no two share an observation; what is
left is one sparse system of six unknowns a camera. Triggs et al., "Bundle Adjustment - A Modern
Synthesis", 2000. Lenses stay as they are.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

STEPS = 50  # at most
ENOUGH = 1e-5  # relative decrease of the loss at which it ends
NEAREST = 1e-3  # of the median depth: observations of points that are nearer, or behind their camera, do not count
DAMPING = 1e-4  # of the first step
ROBUST = 2.0  # median errors, at least px, beyond which the loss grows linearly
FEWEST = 2  # observations of a point that moves


@dataclass(frozen=True)
class Observations:
    """Where views show points: N observations."""

    view: NDArray[np.int64]  # [N]
    point: NDArray[np.int64]  # [N]
    uv: Array  # [N, 2] x / z, y / z in the view's pinhole camera
    focal: Array  # [N, 2] px, so that errors are in px

    def only(self, kept: NDArray[np.bool_]) -> Observations:
        return Observations(self.view[kept], self.point[kept], self.uv[kept], self.focal[kept])

    def __len__(self) -> int:
        return len(self.view)


@dataclass(frozen=True)
class Adjusted:
    """Poses and points after an adjustment."""

    poses: Array  # [V, 4, 4] world to camera
    points: Array  # [P, 3]
    before: float  # median reprojection error, px
    after: float
    observations: int  # that count


def adjust(poses: Array, points: Array, seen: Observations) -> Adjusted:
    """Return poses [V, 4, 4] and points [P, 3] that have a smaller reprojection error.

    A point with fewer than two observations, and a view without any, stay where they are. Nothing
    fixes the world: the steps are the shortest ones, so it moves as little as they say.
    """
    poses, points = poses.copy(), points.copy()
    seen = seen.only(_counted(poses, points, seen))
    if not len(seen):
        return Adjusted(poses, points, float("nan"), float("nan"), 0)
    before = float(np.median(np.linalg.norm(find_errors(poses, points, seen), axis=1)))
    damping, after = DAMPING, before
    for _ in range(STEPS):
        limit = ROBUST * max(1.0, after)
        system = _System(poses, points, seen, limit)
        while damping < 1e6:
            moved = system.step(damping)
            loss = _loss(*moved, seen, limit)
            if loss < system.loss:
                break
            damping *= 8
        else:
            break
        poses, points = moved
        damping = max(damping / 8, 1e-9)
        after = float(np.median(np.linalg.norm(find_errors(poses, points, seen), axis=1)))
        if loss > (1 - ENOUGH) * system.loss:
            break
    return Adjusted(poses, points, before, after, len(seen))


def find_errors(poses: Array, points: Array, seen: Observations) -> Array:
    """Return the reprojection errors [N, 2] in px."""
    x, y, z = _in_camera(poses, points, seen).T
    return (np.stack([x / z, y / z], 1) - seen.uv) * seen.focal


def _in_camera(poses: Array, points: Array, seen: Observations) -> Array:
    R, t = poses[seen.view, :3, :3], poses[seen.view, :3, 3]
    return np.einsum("nij,nj->ni", R, points[seen.point]) + t


def _slopes(poses: Array, points: Array, seen: Observations) -> tuple[Array, Array]:
    """Return the derivatives of the errors by the motions of the cameras [N, 2, 6], as `move` has
    them, and by the points [N, 2, 3]."""
    x, y, z = _in_camera(poses, points, seen).T
    o = np.zeros_like(z)
    rows = np.stack([np.stack([1 / z, o, -x / z**2], 1), np.stack([o, 1 / z, -y / z**2], 1)], 1)
    project = rows * seen.focal[:, :, None]  # [N, 2, 3]
    turn = np.stack([np.stack([o, z, -y], 1), np.stack([-z, o, x], 1), np.stack([y, -x, o], 1)], 1)  # w x p for a turn w
    return np.concatenate([project @ turn, project], 2), project @ poses[seen.view, :3, :3]


def _counted(poses: Array, points: Array, seen: Observations) -> NDArray[np.bool_]:
    """Return which observations count: those in front of their camera, of points with at least two
    of them."""
    depth = _in_camera(poses, points, seen)[:, 2]
    ahead = depth > NEAREST * np.median(np.abs(depth)) if len(depth) else np.zeros(0, bool)
    often = np.bincount(seen.point[ahead], minlength=len(points)) >= FEWEST
    return ahead & often[seen.point]


def _loss(poses: Array, points: Array, seen: Observations, limit: float) -> float:
    """Return the sum of Huber's loss; infinity if a point is behind a camera that shows it."""
    if _in_camera(poses, points, seen)[:, 2].min() <= 0:
        return float("inf")
    size = np.linalg.norm(find_errors(poses, points, seen), axis=1)
    return float(np.where(size <= limit, size**2 / 2, limit * (size - limit / 2)).sum())


class _System:
    """The normal equations at one place."""

    def __init__(self, poses: Array, points: Array, seen: Observations, limit: float) -> None:
        self.poses, self.points, self.seen = poses, points, seen
        self.loss = _loss(poses, points, seen, limit)
        errors, (by_camera, by_point) = find_errors(poses, points, seen), _slopes(poses, points, seen)
        size = np.linalg.norm(errors, axis=1)
        weight = np.minimum(1.0, limit / np.maximum(size, 1e-12))[:, None, None]
        weighted = np.swapaxes(by_camera, 1, 2) * weight
        weighted_point = np.swapaxes(by_point, 1, 2) * weight
        self.U = _gather(weighted @ by_camera, seen.view, len(poses))  # [V, 6, 6]
        self.V = _gather(weighted_point @ by_point, seen.point, len(points))  # [P, 3, 3]
        self.W = weighted @ by_point  # [N, 6, 3]
        self.g = -_gather((weighted @ errors[:, :, None])[..., 0], seen.view, len(poses))  # [V, 6]
        self.h = -_gather((weighted_point @ errors[:, :, None])[..., 0], seen.point, len(points))  # [P, 3]

    def step(self, damping: float) -> tuple[Array, Array]:
        """Return poses and points after a step with this damping."""
        from scipy.sparse import bsr_array  # takes long to import, and most commands do not need it
        from scipy.sparse.linalg import spsolve

        views, points, seen = len(self.poses), len(self.points), self.seen
        inverse = np.linalg.inv(_damped(self.V, damping))
        half = np.linalg.cholesky(inverse)  # inverse = half half^T
        order = np.lexsort((seen.point, seen.view))
        starts = np.searchsorted(seen.view[order], np.arange(views + 1))
        rows = bsr_array(((self.W @ half[seen.point])[order], seen.point[order], starts), shape=(6 * views, 3 * points)).tocsr()
        own = bsr_array((_damped(self.U, damping), np.arange(views), np.arange(views + 1)), shape=(6 * views, 6 * views))
        left = (own.tocsr() - rows @ rows.T).tocsc()
        given = (inverse @ self.h[:, :, None])[..., 0]
        right = self.g - _gather((self.W @ given[seen.point][:, :, None])[..., 0], seen.view, views)
        motion = np.asarray(spsolve(left, right.ravel())).reshape(views, 6)
        back = _gather((np.swapaxes(self.W, 1, 2) @ motion[seen.view][:, :, None])[..., 0], seen.point, points)
        return move(self.poses, motion), self.points + (inverse @ (self.h - back)[:, :, None])[..., 0]


def move(poses: Array, motions: Array) -> Array:
    """Return exp(m) pose for each pose [V, 4, 4] and motion m [V, 6]: rotation about the axes of
    the camera (rad), then translation along them."""
    from scipy.linalg import expm

    x, y, z = motions[:, :3].T
    twist = np.zeros_like(poses)
    twist[:, 0, 1], twist[:, 0, 2], twist[:, 1, 2] = -z, y, -x
    twist[:, 1, 0], twist[:, 2, 0], twist[:, 2, 1] = z, -y, x
    twist[:, :3, 3] = motions[:, 3:]
    return expm(twist) @ poses


def _damped(blocks: Array, damping: float) -> Array:
    """Return blocks [n, k, k] with their diagonals raised; those without observations become the
    identity, so that they do not move."""
    size = blocks.shape[1]
    out, at = blocks.copy(), np.arange(size)
    diagonal = blocks[:, at, at]
    empty = diagonal.max(1) <= 0
    out[:, at, at] += damping * diagonal + 1e-9 * diagonal.max(1, keepdims=True)
    out[empty] = np.eye(size)
    return out


def _gather(rows: Array, where: NDArray[np.int64], count: int) -> Array:
    """Return the sum [count, ...] of the rows [N, ...] by their index."""
    flat = rows.reshape(len(rows), -1)
    out = np.stack([np.bincount(where, column, minlength=count).astype(np.float64) for column in flat.T], 1)
    return out.reshape(count, *rows.shape[1:])
