"""Multi-resolution hash grid (Mueller et al., Instant Neural Graphics Primitives, 2022): maps
positions to learned features.

Level l divides the unit cube into N_l = floor(base growth^l) cells per axis. Features are stored at
the corners of the cells and interpolated trilinearly. If a level has more corners than table rows,
a hash maps corners to shared rows. The compiled library is used if it is available.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated, Any

import torch
from torch import Tensor, nn

from scene_experts.core.errors import InputError
from scene_experts.core.fields import Count, Flag, Range
from scene_experts.core.transfer import upload
from scene_experts.native import library as native

PRIMES = (1, 2_654_435_761, 805_459_861)  # eq. 4 of the paper
INITIAL = 1e-4  # features are initialised uniformly in [-INITIAL, INITIAL]
MOST_LEVELS = 64
LARGEST = 24  # 2^24 rows per level, the largest size in the paper
FINEST = 53  # 2^53 cells per axis: their numbers are exact, and their corners have 64 bits


@dataclass(frozen=True)
class HashGrid:
    """Size of the hash grid."""

    levels: Annotated[int, Range(1, MOST_LEVELS)] = 16
    """Number of levels."""
    features: Count = 2
    """Number of features per level."""
    log2_table: Annotated[int, Range(1, LARGEST)] = 15
    """Base-2 logarithm of the largest table of a level."""
    base: Count = 16
    """Cells per axis at the coarsest level."""
    growth: Annotated[float, Range(1)] = 1.447
    """Ratio of the cells per axis of two successive levels."""

    @property
    def width(self) -> int:
        """Number of features per position."""
        return self.levels * self.features

    def check(self, flag: Flag) -> None:
        if math.log2(self.base) + (self.levels - 1) * math.log2(self.growth) > FINEST:
            raise InputError(
                f"expected at most 2^{FINEST} cells per axis at the finest level, found {self.base} x {self.growth:g}^{self.levels - 1}; "
                f"lower {flag('levels')}, {flag('growth')} or {flag('base')}"
            )

    def resolutions(self) -> list[int]:
        """Number of cells per axis of each level."""
        return [math.floor(self.base * self.growth**level) for level in range(self.levels)]

    def rows(self) -> list[int]:
        """Number of table rows of each level: its number of corners, at most 2^log2_table."""
        return [min((cells + 1) ** 3, 1 << self.log2_table) for cells in self.resolutions()]

    def build(self, low: tuple[float, ...], edge: float) -> Grid:
        return Grid(self, low, edge)


class Grid(nn.Module):
    """Learned table [rows of all levels, features] and the low corner and edge (world units) of the
    cube that it covers."""

    config: HashGrid
    low: tuple[float, ...]
    edge: float
    table: nn.Parameter

    def __init__(self, config: HashGrid, low: tuple[float, ...], edge: float) -> None:
        super().__init__()
        self.config, self.low, self.edge = config, low, edge
        self.table = nn.Parameter(torch.empty(sum(config.rows()), config.features).uniform_(-INITIAL, INITIAL))

    def unit(self, xyz: Tensor) -> Tensor:
        """Convert world positions [A, 3] to grid coordinates: those in the cube around the initial
        points, clamped to [0, 1]."""
        return ((xyz - upload(torch.tensor(self.low, dtype=xyz.dtype), xyz.device)) / self.edge).clamp(0, 1)

    def forward(self, xyz: Tensor) -> Tensor:
        """Features [A, levels * features], level by level, at world positions [A, 3]. Positions get
        no gradient."""
        return encode(self.table, self.unit(xyz), self.config)


def encode(table: Tensor, unit: Tensor, config: HashGrid) -> Tensor:
    """Features [A, levels * features] at positions `unit` [A, 3] in grid coordinates.
    Differentiable in the table only."""
    return _Encode.apply(table, unit, config)  # type: ignore[return-value]


def corners(unit: Tensor, cells: int, rows: int) -> tuple[Tensor, Tensor]:
    """Table rows [A, 8] int64 and trilinear weights [A, 8] of the corners around positions `unit`
    [A, 3].

    The level has `cells` cells per axis and `rows` table rows.
    """
    place = unit * cells
    low = place.floor()
    part = place - low
    axis = torch.stack([low, low + 1], dim=2).long()  # [A, 3, 2]
    share = torch.stack([1 - part, part], dim=2)
    x, y, z = axis[:, 0, :, None, None], axis[:, 1, None, :, None], axis[:, 2, None, None, :]
    if (cells + 1) ** 3 <= rows:
        row = (x + (cells + 1) * (y + (cells + 1) * z)) % rows  # one row per corner; indices outside the cube wrap around
    else:
        row = ((x * PRIMES[0]) ^ (y * PRIMES[1]) ^ (z * PRIMES[2])) & (rows - 1)
    weight = share[:, 0, :, None, None] * share[:, 1, None, :, None] * share[:, 2, None, None, :]
    return row.reshape(-1, 8), weight.reshape(-1, 8)


class _Encode(torch.autograd.Function):
    """Interpolation, level by level. The backward pass recomputes the indices, to store 3 numbers
    per position instead of 256."""

    @staticmethod
    def forward(ctx: Any, table: Tensor, unit: Tensor, config: HashGrid) -> Tensor:
        unit = unit.contiguous()
        ctx.save_for_backward(unit)
        ctx.config, ctx.shape = config, table.shape
        out, library = unit.new_empty(len(unit), config.levels, config.features), native.load()
        if library is None or not _fits(table, unit):
            _forward(table, unit, config, out)
        else:
            sizes = torch.tensor([config.resolutions(), config.rows()])
            columns = [native.pointer(t) for t in (table, unit, sizes[0], sizes[1])]
            library.se_grid_forward(*columns, len(unit), config.levels, config.features, native.pointer(out), native.count_threads())
        return out.view(len(unit), config.width)

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor | None, None, None]:
        (unit,), config, library = ctx.saved_tensors, ctx.config, native.load()
        grad = grads[0].contiguous().view(len(unit), config.levels, config.features)
        if library is None or not _fits(grad, unit):
            return _backward(unit, grad, config), None, None
        out, sizes = grad.new_zeros(ctx.shape), torch.tensor([config.resolutions(), config.rows()])
        columns = [native.pointer(t) for t in (unit, grad, sizes[0], sizes[1])]
        library.se_grid_backward(*columns, len(unit), config.levels, config.features, native.pointer(out), native.count_threads())
        return out, None, None


def _forward(table: Tensor, unit: Tensor, config: HashGrid, out: Tensor) -> None:
    """Fill `out` [A, levels, features] in PyTorch, for any device and dtype."""
    columns, first = table.t().contiguous(), 0  # [features, rows]
    for level, (cells, rows) in enumerate(zip(config.resolutions(), config.rows())):
        row, weight = corners(unit, cells, rows)
        for feature in range(config.features):
            values = columns[feature, first : first + rows].index_select(0, row.view(-1)).view_as(weight)
            out[:, level, feature] = (values * weight).sum(1)
        first += rows


def _backward(unit: Tensor, grad: Tensor, config: HashGrid) -> Tensor:
    """Gradient of the table, in PyTorch."""
    out, first = grad.new_zeros(config.features, sum(config.rows())), 0
    for level, (cells, rows) in enumerate(zip(config.resolutions(), config.rows())):
        row, weight = corners(unit, cells, rows)
        for feature in range(config.features):
            out[feature, first : first + rows].scatter_add_(0, row.view(-1), (weight * grad[:, level, feature, None]).view(-1))
        first += rows
    return out.t().contiguous()


def _fits(*tensors: Tensor) -> bool:
    return all(t.device.type == "cpu" and t.dtype == torch.float32 and t.is_contiguous() for t in tensors)
