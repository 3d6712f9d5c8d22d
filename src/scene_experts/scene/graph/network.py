"""Neighbourhood graph of points and the aggregation of features along it (Ververas et al., SAGS,
ECCV 2024).

Points do not move, so the graph changes only when rows are added or removed. A camera uses the
subgraph of the points it sees.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import torch
from torch import Tensor

from scene_experts.core.transfer import upload
from scene_experts.geometry.neighbours import find_neighbours
from scene_experts.native import library as native

NEAREST = 1e-8  # lower bound of the distance between two points


@dataclass(frozen=True)
class Graph:
    """Neighbours of each point: `index` [N, k] int64 and `closeness` [N, k] float32 (1 / distance).

    The first neighbour is the point itself, with closeness 0.
    """

    index: Tensor
    closeness: Tensor

    @classmethod
    def of(cls, xyz: Tensor, k: int) -> Graph:
        """Build the exact graph of points [N, 3] with their k - 1 nearest neighbours. The result
        depends on the positions only.

        It is built on the CPU. Points on another device are copied to it once, and the graph from
        it.
        """
        here = xyz.detach().cpu()
        d2, others = find_neighbours(here, k - 1)
        me = torch.arange(len(here))[:, None]
        close = 1 / d2.sqrt().clamp_min(NEAREST)
        made = cls(torch.cat([me, others], dim=1), torch.cat([d2.new_zeros(len(here), 1), close], dim=1).to(xyz.dtype))
        return made.change(lambda t: upload(t, xyz.device))

    def change(self, fn: Callable[[Tensor], Tensor]) -> Graph:
        """Return the graph with a function applied to its tensors, such as a copy to a device."""
        return Graph(fn(self.index), fn(self.closeness))

    @cached_property
    def reverse(self) -> tuple[Tensor, Tensor]:
        """Edges by the neighbour that they lead to: where the list of each point begins, [N + 1],
        and the edges u k + j of all lists, ascending in each, [N k], int64.

        Made by three operations on the graph's device, without a wait of the host.
        """
        to, known = self.index.reshape(-1).sort(stable=True)
        return torch.searchsorted(to, torch.arange(len(self.index) + 1, device=to.device)), known

    def among(self, rows: Tensor) -> tuple[Tensor, Tensor]:
        """Subgraph of `rows` [A]: neighbours [A, k] as indices into `rows` (-1 if the neighbour is
        not in `rows`) and weights [A, k].

        The weight of a neighbour is its closeness, divided by the sum over all neighbours and by
        the number of neighbours, including the point itself.
        """
        place = torch.full((len(self.index),), -1, dtype=torch.int64, device=rows.device)
        place[rows] = torch.arange(len(rows), device=rows.device)
        found = place[self.index.index_select(0, rows)]
        there = found >= 0
        close = self.closeness.index_select(0, rows) * there
        total = close.sum(1, keepdim=True) * there.sum(1, keepdim=True)
        return found, close / total.clamp_min(torch.finfo(close.dtype).tiny)


def blend_neighbours(feature: Tensor, found: Tensor, weight: Tensor, share: float = 0.5) -> Tensor:
    """f_u + share * sum_v w_uv h_v, with h_v = max over the points u that have v as a neighbour of
    (f_v - f_u), element-wise; [A, F].

    feature [A, F]; found [A, k] (-1: no neighbour) and weight [A, k] of `Graph.among`.
    Differentiable in the features. If several points attain a maximum, they share its gradient
    equally.
    """
    return _Blend.apply(feature, found, weight, share)  # type: ignore[return-value]


class _Blend(torch.autograd.Function):
    """Uses the compiled library for float32 tensors on the CPU, and PyTorch otherwise."""

    @staticmethod
    def forward(ctx: Any, feature: Tensor, found: Tensor, weight: Tensor, share: float) -> Tensor:
        parts, library = (feature.contiguous(), found.contiguous(), weight.contiguous()), native.load()
        ctx.share = share
        fits = all(t.device.type == "cpu" for t in parts) and feature.dtype == weight.dtype == torch.float32
        if library is None or not fits or found.numel() >= 2**31:
            least, out = _forward(*parts, share)
            ctx.save_for_backward(*parts, least)
            return out
        (A, F), k, (feature, found, weight) = feature.shape, found.shape[1], parts
        start, known = torch.empty(A + 1, dtype=torch.int32), torch.empty(A * k, dtype=torch.int32)
        least, out = torch.empty_like(feature), torch.empty_like(feature)
        library.se_graph_reverse(native.pointer(found), A, k, native.pointer(start), native.pointer(known))
        columns = [native.pointer(t) for t in (feature, found, weight, start, known)]
        library.se_graph_forward(*columns, A, k, F, share, native.pointer(least), native.pointer(out), native.count_threads())
        ctx.save_for_backward(*parts, least, start, known)
        return out

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor | None, None, None, None]:
        feature, found, weight, least, *reverse = ctx.saved_tensors
        if not reverse:
            return _backward(feature, found, weight, least, grads[0], ctx.share), None, None, None
        library, (A, F), k = native.require(), feature.shape, found.shape[1]
        h, shared, out, grad = *(torch.empty_like(feature) for _ in range(3)), grads[0].contiguous()
        columns = [native.pointer(t) for t in (feature, least, grad, found, weight, *reverse)]
        rooms = [native.pointer(t) for t in (h, shared, out)]
        library.se_graph_backward(*columns, A, k, F, ctx.share, *rooms, native.count_threads())
        return out, None, None, None


def _forward(feature: Tensor, found: Tensor, weight: Tensor, share: float) -> tuple[Tensor, Tensor]:
    """Returns the minima over the points that have a point as a neighbour, and the blended
    features, [A, F] each.

    Works neighbour by neighbour, to avoid tensors of size A k F.
    """
    least = feature.clone()  # min over u of f_u; a point is a neighbour of itself
    for me, other, _, _ in _columns(found, weight):
        least.scatter_reduce_(0, other[:, None].expand(-1, feature.shape[1]), feature.index_select(0, me), "amin")
    difference, out = feature - least, feature.clone()
    for me, other, w, _ in _columns(found, weight):
        out.index_add_(0, me, difference.index_select(0, other).mul_(share * w[:, None]))
    return least, out


def _backward(feature: Tensor, found: Tensor, weight: Tensor, least: Tensor, grad: Tensor, share: float) -> Tensor:
    """Gradient of the features [A, F]."""
    to, ties = torch.zeros_like(feature), torch.zeros_like(feature)  # gradients of h; number of points that attain each minimum
    for me, other, w, there in _columns(found, weight):
        where = other[:, None].expand(-1, grad.shape[1])
        to.scatter_add_(0, where, grad.index_select(0, me).mul_(share * w[:, None]))
        hit = (feature.index_select(0, me) == least.index_select(0, other)) & there
        ties.scatter_add_(0, where, hit.to(grad.dtype))
    out, to = grad + to, to / ties.clamp_min(1)
    for me, other, _, there in _columns(found, weight):
        hit = (feature.index_select(0, me) == least.index_select(0, other)) & there
        out.index_add_(0, me, to.index_select(0, other).mul_(hit), alpha=-1)
    return out


def _columns(found: Tensor, weight: Tensor) -> list[tuple[Tensor, Tensor, Tensor, Tensor]]:
    """For each j: the points that have a j-th neighbour, this neighbour, its weight, and [.., 1]
    bool: whether it is there.

    Selecting points would synchronise the host with a GPU. There all points are listed, and a
    missing neighbour is the point itself with the weight 0.
    """
    out, everyone, yes = [], torch.arange(len(found), device=found.device), torch.ones((), dtype=torch.bool, device=found.device)
    for j in range(found.shape[1]):
        there = found[:, j] >= 0
        if found.device.type == "cpu":
            me = there.nonzero().squeeze(1)
            out.append((me, found[:, j].index_select(0, me), weight[:, j].index_select(0, me), yes))
        else:
            out.append((everyone, torch.where(there, found[:, j], everyone), torch.where(there, weight[:, j], 0.0), there[:, None]))
    return out
