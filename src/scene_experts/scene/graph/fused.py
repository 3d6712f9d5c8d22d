"""The decode of graph points on CUDA with Triton kernels: the inputs of the networks (hash grid,
blend along the graph, view), the folded first layers, and the Gaussians.

They are `encode`, `view`, `fold` and `place` of `GraphScene`, the reference. torch multiplies the
matrices. Sums over points either have a fixed order or are of integers: the same inputs give the
same bits.
"""

from __future__ import annotations

import functools
import importlib
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from scene_experts.core.transfer import upload
from scene_experts.native import triton
from scene_experts.scene.graph.hash_grid import Grid, HashGrid
from scene_experts.scene.graph.network import Graph

BLOCK_GRID = 128  # points per program of one level
BLOCK = 16  # points per program of the graph, with all channels
BLOCK_TABLE = 1024  # values of the table per program
BLOCK_PLACE = 128  # Gaussians per program
COLUMNS, ROWS = 16, 32  # of a tile of a folded layer


@dataclass(frozen=True)
class _Seen:
    """Inputs that are not differentiated."""

    graph: Graph
    grid: Grid
    xyz: Tensor  # [N, 3]
    rows: Tensor  # [A] int64
    place: Tensor  # [N] int32: index into `rows`, or -1
    camera: Tensor | None  # [3]
    share: float

    def sizes(self, F: int) -> dict[str, Any]:
        """Compile-time constants of the kernels of the graph for F channels."""
        return {"K": self.graph.index.shape[1], "F": F, "B": BLOCK, "FP": _pad(F)}

    def columns(self, F: int) -> dict[str, Any]:
        """Those of the kernels that use the inputs, too."""
        view = self.camera is not None
        return {"VIEW": view, "WIDTH": self.grid.config.width + F + 4 * view}


def encode(
    feature: Tensor, grid: Grid, graph: Graph, xyz: Tensor, rows: Tensor, share: float, camera: Tensor | None = None
) -> tuple[Tensor, Tensor]:
    """Return the inputs of the networks [A, grid + F (+ 4)] and the maximum of the features [F].

    A row of the inputs has the features of the hash grid, the blended features, and with `camera`
    the unit direction from it and the distance in world units. Differentiable in `feature` and the
    grid's table. If several points attain a maximum, they share its gradient equally. All tensors
    are float32 on one device, on which Triton runs, unless noted.

    Args:
        feature: Features of all points [N, F].
        grid: The hash grid.
        graph: The graph of all points.
        xyz: Positions [N, 3] in world units.
        rows: Visible points [A] int64, without duplicates and inside the table. This is not
            checked, because the check would wait for the device.
        share: Weight of the neighbours in the feature of a point.
        camera: Camera centre [3] in world units.
    """
    xyz, rows = xyz.detach().contiguous(), rows.contiguous()
    place = torch.full((len(xyz),), -1, dtype=torch.int32, device=xyz.device)
    place.index_copy_(0, rows, torch.arange(len(rows), dtype=torch.int32, device=xyz.device))
    camera = None if camera is None else camera.detach().to(xyz).contiguous()
    return _Inputs.apply(feature, grid.table, _Seen(graph, grid, xyz, rows, place, camera, share))  # type: ignore[return-value]


class _Inputs(torch.autograd.Function):
    """The backward pass recomputes the corners and the weights, and keeps the minima."""

    @staticmethod
    def forward(ctx: Any, feature: Tensor, table: Tensor, plan: _Seen) -> tuple[Tensor, Tensor]:
        A, F = len(plan.rows), feature.shape[1]
        ctx.plan, ctx.shapes = plan, (feature.shape, table.shape)
        inputs = feature.new_empty(A, plan.columns(F)["WIDTH"])
        if A == 0:
            ctx.save_for_backward()
            return inputs, feature.new_zeros(F)
        own = feature.index_select(0, plan.rows)
        strongest, least, totals = own.amax(0), torch.empty_like(own), own.new_empty(A)
        _launch_grid("grid_forward", plan, inputs.shape[1], table.contiguous(), inputs)
        graph, blocks = plan.graph, (_count(A, BLOCK),)
        start, known = graph.reverse
        triton.launch(_kernel("neighbour_minima"), blocks, own, plan.rows, plan.place, start, known, least, A, **plan.sizes(F))
        camera = plan.xyz if plan.camera is None else plan.camera  # not read without a camera
        tensors = (own, least, plan.rows, plan.place, graph.index, graph.closeness, plan.xyz, camera, inputs, totals)
        triton.launch(_kernel("blend_forward"), blocks, *tensors, A, plan.share, **plan.sizes(F), **plan.columns(F))
        ctx.save_for_backward(own, least, totals, strongest)
        return inputs, strongest

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor, Tensor, None]:
        plan, (of_feature, of_table), A, F = ctx.plan, ctx.shapes, len(ctx.plan.rows), ctx.shapes[0][1]
        d_inputs = grads[0].contiguous()
        d_feature, sums = d_inputs.new_zeros(of_feature), d_inputs.new_zeros(of_table, dtype=torch.int64)
        if A == 0:
            return d_feature, sums.to(d_inputs.dtype), None
        own, least, totals, strongest = ctx.saved_tensors
        d_table, peak = d_inputs.new_empty(of_table), torch.linalg.vector_norm(d_inputs[:, : plan.grid.config.width], torch.inf)
        scale = 2.0 ** (62 - A.bit_length())
        _launch_grid("grid_backward", plan, d_inputs.shape[1], d_inputs, peak, sums, numbers=(scale,))
        M = d_table.numel()
        triton.launch(_kernel("grid_gradient"), (_count(M, BLOCK_TABLE),), sums, peak, d_table, M, scale, B=BLOCK_TABLE)
        d_strongest = grads[1] / (own == strongest).sum(0)
        graph, blocks, shared = plan.graph, (_count(A, BLOCK),), torch.empty_like(own)
        start, known = graph.reverse
        lists = (own, least, plan.rows, plan.place, start, known, graph.closeness, totals, d_inputs, strongest, d_strongest)
        sizes = plan.sizes(F)
        triton.launch(_kernel("minima_backward"), blocks, *lists, shared, d_feature, A, plan.share, **sizes, **plan.columns(F))
        triton.launch(_kernel("blend_backward"), blocks, own, least, plan.rows, plan.place, graph.index, shared, d_feature, A, **sizes)
        return d_feature, d_table, None


def fold(weight: Tensor, alpha: Tensor, beta: Tensor, strongest: Tensor, columns: int) -> tuple[Tensor, Tensor]:
    """Return the weight [H, columns] and bias [H] of `GraphScene.fold`. Differentiable.

    Args:
        weight: First layer [H, W], or [H, W + 4] with the view.
        alpha: Factors of the affine layer [W].
        beta: Summands of the affine layer [W].
        strongest: Values of the last F of the W columns [F].
        columns: At least those of `weight` less F. The others are 0.
    """
    return _Fold.apply(weight, alpha, beta, strongest, columns)  # type: ignore[return-value]


class _Fold(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, weight: Tensor, alpha: Tensor, beta: Tensor, strongest: Tensor, columns: int) -> tuple[Tensor, Tensor]:
        parts = tuple(t.contiguous() for t in (weight, alpha, beta, strongest))
        (H, width), F = weight.shape, len(strongest)
        ctx.save_for_backward(*parts)
        ctx.sizes = {"IN": width, "OUT": columns, "WIDTH": len(alpha), "F": F}
        out, bias = weight.new_empty(H, columns), weight.new_empty(H)
        triton.launch(_kernel("fold_forward"), (H,), *parts, out, bias, **ctx.sizes, CP=_pad(columns + F))
        return out, bias

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor | None, ...]:
        parts, (H, width) = ctx.saved_tensors, ctx.saved_tensors[0].shape
        found = tuple(torch.empty_like(t) for t in parts)
        up = (grads[0].contiguous(), grads[1].contiguous())
        sizes = {"H": H, **ctx.sizes, "B": COLUMNS, "HB": ROWS}
        triton.launch(_kernel("fold_backward"), (_count(width, COLUMNS),), *parts, *up, *found, **sizes)
        return *found, None


def place(
    keep: Tensor, source: Tensor, xyz: Tensor, log_scaling: Tensor, offset: Tensor, shape: Tensor, color: Tensor, raw: Tensor
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """Return means [M, 3], unit quaternions [M, 4], scales [M, 3], opacities [M] and colours [M, 3]
    of the drawn Gaussians.

    The arguments are those of `GraphScene.place`, and the columns of the table. Differentiable in
    `log_scaling` to `raw`. Neither `keep` nor `source` may have duplicates.
    """
    return _Place.apply(keep, source, xyz, log_scaling, offset, shape, color, raw)  # type: ignore[return-value]


class _Place(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, *tensors: Tensor) -> tuple[Tensor, ...]:
        keep, source, xyz, *values = (t.contiguous() for t in tensors)
        M = len(source)
        out = tuple(xyz.new_empty(M, *rest) for rest in ((3,), (4,), (3,), (), (3,)))
        if M:
            triton.launch(_kernel("place_points"), (_count(M, BLOCK_PLACE),), keep, source, xyz, *values, *out, M, B=BLOCK_PLACE)
        ctx.save_for_backward(keep, source, *values[:3], out[1], out[4])
        ctx.shapes = tensors[3].shape, tensors[7].shape
        return out

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor | None, ...]:
        saved, up = ctx.saved_tensors, [g.contiguous() for g in grads]
        M, of_scaling, of_raw = len(saved[0]), *ctx.shapes
        parts = [torch.empty_like(saved[3]), torch.empty_like(saved[4]), torch.empty_like(up[4])]
        found = [up[0].new_zeros(of_scaling), *parts, up[0].new_zeros(of_raw)]
        if M:
            triton.launch(_kernel("place_points_backward"), (_count(M, BLOCK_PLACE),), *saved, *up, *found, M, B=BLOCK_PLACE)
        return None, None, None, *found


def _launch_grid(name: str, plan: _Seen, width: int, *tensors: Tensor, numbers: tuple[float, ...] = ()) -> None:
    """Launch a kernel of the hash grid, a program for each block of points and level. width: that
    of the inputs."""
    A, grid, config = len(plan.rows), plan.grid, plan.grid.config
    sizes = {"L": config.levels, "C": config.features, "WIDTH": width, "B": BLOCK_GRID, "CP": _pad(config.features, 1)}
    cube = (*(float(v) for v in grid.low), float(grid.edge))
    levels = _describe_levels(config, plan.xyz.device)
    triton.launch(_kernel(name), (_count(A, BLOCK_GRID), config.levels), plan.xyz, plan.rows, levels, *tensors, A, *cube, *numbers, **sizes)


@functools.lru_cache(maxsize=16)
def _describe_levels(config: HashGrid, device: torch.device) -> Tensor:
    """For each level the first table row, the number of rows, cells per axis and 1 if each corner
    has its own row, [L, 4] int64."""
    levels, first = [], 0
    for cells, rows in zip(config.resolutions(), config.rows()):
        levels.append((first, rows, cells, int((cells + 1) ** 3 <= rows)))
        first += rows
    return upload(torch.tensor(levels), device)


def _kernel(name: str) -> Any:
    return getattr(importlib.import_module("scene_experts.scene.graph.triton_kernels"), name)


def _count(n: int, block: int) -> int:
    return -(-n // block)


def _pad(n: int, least: int = 16) -> int:
    """Return the smallest power of two that is at least n and `least`."""
    return max(least, 1 << (n - 1).bit_length())
