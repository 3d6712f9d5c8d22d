"""What views show of a scene's Gaussians: their contributions, means over the views, how often they
are left out, and their colours.

The contribution of a Gaussian to a picture is the sum over pixels of its blending weight T alpha:
the derivative of the picture's sum with respect to its colour. S slots (rows times Gaussians per
row), M Gaussians of one view, C = (degree + 1)^2 harmonics.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor
from torch.nn import functional

from scene_experts.core.types import Camera, Gaussians
from scene_experts.files.measure import Painter, Tell
from scene_experts.geometry.sh import C0, basis
from scene_experts.render import Rasterizer

RIDGE = 0.003  # weight of the harmonics above the constant, in units of the Gaussian's contribution
_SOLVE = 4000  # systems of equations per call of the solver
_ROOM = 256 << 20  # bytes for colours and contributions of the Gaussians that are fitted together


@dataclass(frozen=True)
class Sums:
    """Sums over views for every slot of a scene."""

    weight: Tensor  # [S] contribution
    potential: Tensor  # [S] contribution / opacity: about what a small Gaussian would contribute if it were opaque
    means: Tensor  # [S, 3] times contribution, as are the next two
    log_scales: Tensor  # [S, 3]
    quats: Tensor  # [S, 4], signs aligned
    of_views: tuple[Tensor, ...]  # contributions [M] of each view's Gaussians, in the order of drawing

    def opacity(self) -> Tensor:
        """Mean opacity [S] in [0, 1] over the views that drew the slot, weighted by potential
        contribution."""
        return (self.weight / self.potential.clamp_min(1e-12)).clamp(0, 1)


def contributions(gaussians: Gaussians, camera: Camera, rasterize: Rasterizer) -> Tensor:
    """The blending weights of Gaussians summed over the pixels of a picture, [M]."""
    colors = torch.zeros_like(gaussians.colors).requires_grad_()
    with torch.enable_grad():
        image = rasterize(replace(gaussians, colors=colors), camera, colors.new_zeros(3)).image
        (by_color,) = torch.autograd.grad(image[..., 0].sum(), colors)
    return by_color[:, 0].clamp_min(0)


@torch.no_grad()
def sum_views(painter: Painter, slots: int, cameras: Sequence[Camera], tell: Tell) -> Sums:
    """Sums over the pictures of `cameras`. slots: rows of the scene's table times Gaussians per
    row."""
    total, of_views = torch.zeros(slots, 12), []  # weight, potential, means, log-scales, quaternions
    for i, camera in enumerate(cameras):
        g = painter.gaussians(camera)
        of_views.append(contributions(g, camera, painter.rasterize))
        w, before = of_views[-1][:, None], total.index_select(0, g.source)
        sign = torch.where((before[:, 8:] * g.quats).sum(1, keepdim=True) < 0, -1.0, 1.0)
        parts = [w, w / g.opacities[:, None].clamp_min(1e-6), w * g.means, w * g.scales.clamp_min(1e-12).log()]
        total.index_copy_(0, g.source, before.add_(torch.cat([*parts, w * sign * g.quats], dim=1)))  # a slot is drawn at most once
        tell("summing contributions", i + 1, len(cameras))
    return Sums(total[:, 0], total[:, 1], total[:, 2:5], total[:, 5:8], total[:, 8:], tuple(of_views))


@torch.no_grad()
def omission(painter: Painter, slots: Tensor, total: int, means: Tensor, sizes: Tensor, cameras: Sequence[Camera], tell: Tell) -> Tensor:
    """How much the Gaussians at `slots` [n] (of `total`) are left out where they would be seen,
    relative to how much they are drawn, [n].

    A scene leaves a Gaussian out where its opacity is negative or its anchor is outside the
    picture. Its contribution would be proportional to its area in the picture, so views count by
    the inverse square of the distance. means [n, 3]; sizes [n]: largest standard deviations.
    """
    ball = sizes[:, None].expand(-1, 3).contiguous()
    drawn, on, off = torch.zeros(total, dtype=torch.bool), torch.zeros(len(slots)), torch.zeros(len(slots))
    for i, camera in enumerate(cameras):
        drawn.zero_()
        drawn[painter.gaussians(camera).source] = True
        is_drawn = drawn.index_select(0, slots)
        area = 1 / (means - camera.position).square().sum(1).clamp_min(camera.near**2)
        on += area * is_drawn
        off += area * (painter.rasterize.visible(means, ball, camera) & ~is_drawn)
        tell("finding omissions", i + 1, len(cameras))
    return off / on.clamp_min(1e-12)


@torch.no_grad()
def fit_harmonics(painter: Painter, slots: Tensor, sums: Sums, means: Tensor, degree: int, cameras: Sequence[Camera], tell: Tell) -> Tensor:
    """Harmonics [n, C, 3] of the Gaussians at `slots` [n]: least squares over the views, weighted
    by contribution.

    Minimises sum_v w (0.5 + Y beta - colour)^2 + RIDGE sum_v w |beta without its constant|^2 for
    each Gaussian and channel, with Y the harmonics of the direction from the camera to `means` [n,
    3]. Gaussians are fitted in groups that fit into _ROOM bytes.
    """
    V, n = len(cameras), len(slots)
    many = max(1, _ROOM // (16 * V))
    centres = torch.stack([camera.position for camera in cameras])
    out, parts = [], [slots[i : i + many] for i in range(0, n, many)]
    for k, part in enumerate(parts):
        place = torch.full((len(sums.weight),), -1, dtype=torch.int64)
        place[part] = torch.arange(len(part))
        weight, colour = torch.zeros(V, len(part)), torch.zeros(V, len(part), 3)
        for v, camera in enumerate(cameras):
            g = painter.gaussians(camera)
            at = place.index_select(0, g.source)
            chosen = (at >= 0).nonzero().squeeze(1)
            at = at.index_select(0, chosen)
            weight[v].index_copy_(0, at, sums.of_views[v].index_select(0, chosen))
            colour[v].index_copy_(0, at, g.colors.index_select(0, chosen) - 0.5)
            tell("fitting colours", k * V + v + 1, len(parts) * V)
        where = means[k * many : k * many + len(part)]
        for i in range(0, len(part), _SOLVE):
            rows = slice(i, i + _SOLVE)
            out.append(solve(where[rows], centres, weight[:, rows].T, colour[:, rows].transpose(0, 1), degree))
    return torch.cat(out)


def solve(means: Tensor, centres: Tensor, weight: Tensor, colour: Tensor, degree: int) -> Tensor:
    """The least-squares harmonics [n, C, 3] of Gaussians at `means` [n, 3] seen from `centres` [V,
    3]. See `fit_harmonics`.

    weight [n, V] of each view; colour [n, V, 3] minus 0.5. A Gaussian without weight gets zeros.
    """
    total = weight.sum(1, keepdim=True).clamp_min(1e-12)
    weight = weight / total
    Y = basis(functional.normalize(means[:, None] - centres, dim=2), degree)  # [n, V, C]
    weighted = (Y * weight[..., None]).transpose(1, 2)
    A = weighted @ Y
    A.diagonal(dim1=1, dim2=2)[:, 1:] += RIDGE
    A[:, 0, 0].clamp_min_(C0 * C0 * 1e-3)
    return torch.linalg.solve(A, weighted @ colour)
