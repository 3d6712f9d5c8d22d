"""Which views a view is compared with, and between which depths: from the cameras and the capture's
points alone."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from scene_experts.data.dense.pictures import SmallPictures

BEST_ANGLE = 10.0  # degrees between the rays of two views to a point: less is inexact, more looks different
NARROWER, WIDER = 5.0, 10.0  # standard deviations of the weight of smaller and of larger angles, degrees
LEAST_SHARED = 10  # points that two views must share
QUANTILES = (0.01, 0.99)  # of the depths of the points that a view shows
MARGINS = (0.8, 1.3)  # factors of these depths: the range of the sweep
_MOST, _WORK = 2000, 2e8  # points that decide, and pairs of views times points
_FEW, _MEASURED_VIEWS = 16, 32  # points that make a view likely, and views whose angle is measured
_MEASURED = 100_000  # points whose depths are looked at


@dataclass(frozen=True)
class Pairs:
    """The comparisons of V views."""

    compared: Tensor  # [V, k] int32, views in order of merit; -1: none
    planes: Tensor  # [V, 2] float64, inverse depth of the farthest and of the nearest plane; 0 for a view without a sweep

    @property
    def swept(self) -> int:
        """Number of views with a sweep."""
        return int((self.planes[:, 1] > 0).sum())

    def partners(self) -> tuple[Tensor, Tensor]:
        """Return the views that each view is compared with or that are compared with it: the others
        of view v are others[first[v]:first[v + 1]]; first [V + 1] int64, others int32."""
        known: list[set[int]] = [set() for _ in range(len(self.compared))]
        for view, row in enumerate(self.compared.tolist()):
            for other in row:
                if other >= 0 and self.planes[other, 1] > 0 and self.planes[view, 1] > 0:
                    known[view].add(other)
                    known[other].add(view)
        first = np.concatenate(([0], np.cumsum([len(s) for s in known])))
        return torch.from_numpy(first), torch.tensor([other for s in known for other in sorted(s)], dtype=torch.int32)


def choose_pairs(pictures: SmallPictures, xyz: NDArray[np.float64], k: int) -> Pairs:
    """Choose up to `k` views for each view to be compared with, and its range of depths.

    The merit of a pair is the share of the view's points [P, 3] that both show, times a Gaussian of
    the median angle between their rays. A view that fewer than two others fit, or that shows hardly
    any points, gets none.
    """
    count = len(pictures)
    most = int(np.clip(_WORK / max(count, 1) ** 2, 100, _MOST))
    chosen, xyz = _spread(xyz, most), _spread(xyz, _MEASURED)
    shown = np.stack([pictures.project(view, chosen)[1] for view in range(count)])
    rays = _unit(chosen[None] - pictures.centres[:, None])  # [V, S, 3]
    forward = pictures.rotations[0][:, 2]
    compared = np.full((count, k), -1, dtype=np.int32)
    planes = np.zeros((count, 2))
    for view in range(count):
        merit = _merits(view, shown, rays, forward)
        order = [int(other) for other in np.argsort(-merit, kind="stable")[:k] if merit[other] > 0]
        local, inside = pictures.project(view, xyz)
        if len(order) < 2 or int(inside.sum()) < LEAST_SHARED:
            continue
        compared[view, : len(order)] = order
        near, far = np.quantile(local[inside, 2], QUANTILES) * MARGINS
        planes[view] = 1 / far, 1 / near
    return Pairs(torch.from_numpy(compared), torch.from_numpy(planes))


def _merits(view: int, shown: NDArray[np.bool_], rays: NDArray[np.float64], forward: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the merit of each view for `view`, [V]; 0: unfit. Only those that a few points make
    likely are measured."""
    mine = np.flatnonzero(shown[view])
    merit = np.zeros(len(shown))
    both = shown[:, mine]
    shared = both.sum(1)
    ahead = (forward * forward[view]).sum(1) > 0
    fit = (shared >= LEAST_SHARED) & ahead
    fit[view] = False
    few = _spread(mine, _FEW)
    likely = np.where(fit, shared * _weights(np.median((rays[:, few] * rays[view, few]).sum(2), 1)), -1) if len(few) else merit - 1
    for other in np.argsort(-likely, kind="stable")[:_MEASURED_VIEWS]:
        if fit[other]:
            at = mine[both[other]]
            merit[other] = shared[other] / len(mine) * _weights(np.median((rays[view, at] * rays[other, at]).sum(1)))
    return np.where(merit > 1e-6, merit, 0.0)


def _weights(cosines: NDArray[np.float64] | np.float64) -> NDArray[np.float64]:
    """Return the weights of angles."""
    angle = np.degrees(np.arccos(np.clip(cosines, -1, 1)))
    width = np.where(angle < BEST_ANGLE, NARROWER, WIDER)
    return np.exp(-((angle - BEST_ANGLE) ** 2) / (2 * width**2))


def _spread(values: NDArray[Any], most: int) -> NDArray[Any]:
    """Return at most `most` of the values, evenly spread over their order."""
    return values[np.linspace(0, len(values) - 1, min(most, len(values))).round().astype(np.int64)]


def _unit(xyz: NDArray[np.float64]) -> NDArray[np.float64]:
    length = np.sqrt((xyz**2).sum(-1, keepdims=True))
    return xyz / np.maximum(length, 1e-300)
