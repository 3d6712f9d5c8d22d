"""The integer lattice of the anchors. Cells are int64 triples, so that neither rounding nor the
device affects comparisons of cells.

Scaffold-GS keeps float positions and rounds them again for each cell size. Anchors then lie on
rounding ties, and float32 and float64 disagree for up to a fifth of them. This module rounds a
point once, in float64, and derives coarser cells by integer arithmetic.
"""

from __future__ import annotations

from typing import Literal

import torch
from torch import Tensor

from scene_experts.core.errors import InputError
from scene_experts.geometry.neighbours import find_neighbours, knn_d2, median_neighbour_distance

VoxelRule = Literal["squared_median", "median_nn"]
VoxelChoice = Literal["neighbours", "squared_median", "median_nn"]
AXIS_BITS = 21
AXIS_LIMIT = 1 << (AXIS_BITS - 1)  # coordinates of cells lie in [-AXIS_LIMIT, AXIS_LIMIT)


def to_lattice(points: Tensor, size: float) -> Tensor:
    """Cells [N, 3] int64 of `points` [N, 3] on a lattice of edge `size` (world units): round(point
    / size) in float64, ties to even.

    Raises InputError for coordinates that are not finite or too large for exact float64 cell
    numbers (2^53).
    """
    if not size > 0:
        raise InputError(f"expected a voxel size above 0, found {size}; give one with --scene.voxel-size, or 0 for the automatic size")
    cells = torch.round(points.detach().to(torch.float64) / size)
    if not bool((cells.abs() < 2.0**53).all()):
        raise InputError(
            f"expected finite points within 2^53 voxels of {size:g} of the origin, found others; remove outliers or give a larger "
            f"--scene.voxel-size"
        )
    return cells.to(torch.int64)


def coarsen(cells: Tensor, m: int) -> Tensor:
    """Cells of an m times coarser lattice: floor((i + m/2) / m) in integers, so ties round up. m =
    1 returns equal cells."""
    if m < 1:
        raise ValueError(f"expected a factor of at least 1 between cell sizes, found {m}")
    if m & (m - 1) == 0:
        return (2 * cells + m) >> m.bit_length()  # the same, several times faster
    return torch.div(2 * cells + m, 2 * m, rounding_mode="floor")


def pack(cells: Tensor) -> Tensor:
    """One int64 key [N] per cell [N, 3], 21 bits per axis. Keys sort like (x, y, z). Raises
    InputError for a cell outside [-2^20, 2^20)."""
    if cells.numel() and not bool(((cells >= -AXIS_LIMIT) & (cells < AXIS_LIMIT)).all()):
        found = int(cells.abs().max())
        raise InputError(
            f"expected voxel numbers within {AXIS_LIMIT:,} of the origin, found {found:,}; remove outliers or give a larger "
            f"--scene.voxel-size"
        )
    x, y, z = (cells + AXIS_LIMIT).unbind(-1)
    return (x << (2 * AXIS_BITS)) | (y << AXIS_BITS) | z


def unpack(keys: Tensor) -> Tensor:
    """Cells [N, 3] of keys [N], the inverse of `pack`."""
    mask = (1 << AXIS_BITS) - 1
    return torch.stack([(keys >> (2 * AXIS_BITS)) & mask, (keys >> AXIS_BITS) & mask, keys & mask], dim=-1) - AXIS_LIMIT


def find_unique_cells(cells: Tensor) -> tuple[Tensor, Tensor]:
    """The distinct cells [U, 3] in the order of (x, y, z), and the index [N] of each of `cells` [N,
    3] among them."""
    keys, inverse = torch.unique(pack(cells), return_inverse=True)
    return unpack(keys), inverse


def in_set(keys: Tensor, others: Tensor) -> Tensor:
    """Whether each of `keys` [N] occurs among `others` [M] (any order, repeats allowed), [N]
    bool."""
    if not others.numel() or not keys.numel():
        return torch.zeros_like(keys, dtype=torch.bool)
    if len(keys) < len(others):  # sort the shorter list and look the longer one up
        ordered, place = keys.unique(return_inverse=True)
        at = torch.searchsorted(ordered, others).clamp_max(len(ordered) - 1)
        hit = torch.zeros_like(ordered, dtype=torch.bool)
        hit[at[ordered[at] == others]] = True
        return hit[place]
    ordered = others.sort().values
    at = torch.searchsorted(ordered, keys).clamp_max(len(ordered) - 1)
    return ordered[at] == keys


def scatter_max(values: Tensor, group: Tensor, groups: int) -> Tensor:
    """Element-wise maximum [groups, F] of the rows of `values` [P, F] per `group` [P]; 0 for a
    group without rows."""
    out = values.new_zeros((groups, values.shape[1]))
    return out.scatter_reduce(0, group[:, None].expand_as(values), values, reduce="amax", include_self=False)


def choose_voxel_size(points: Tensor, rule: VoxelChoice) -> float:
    """Edge of the lattice for points [P, 3], in their unit: a quarter of the median neighbour
    distance, or as `estimate_voxel_size`.

    Raises InputError if no two points differ.
    """
    if rule != "neighbours":
        return estimate_voxel_size(points, rule)
    spacing = median_neighbour_distance(points)
    return 0.25 * spacing if spacing > 0 else estimate_voxel_size(points, "median_nn", 0.25)  # more than half of the points coincide


def estimate_voxel_size(points: Tensor, rule: VoxelRule = "squared_median", factor: float = 1.0) -> float:
    """A voxel size from the spacing of `points` [P, 3], times `factor`.

    "squared_median" is the computation of Scaffold-GS: the int(P / 2)-th smallest mean *squared*
    distance to 3 neighbours, without a root, so it depends quadratically on the unit. "median_nn"
    is its documentation: the median distance to the nearest neighbour in world units. If more than
    half of the points coincide, only points with a positive spacing count. Raises InputError if no
    two points differ.
    """
    if rule == "squared_median":
        spacing = knn_d2(points)
    elif rule == "median_nn":
        spacing = find_neighbours(points, 1)[0].flatten().sqrt()
    else:
        raise ValueError(f"expected the rule squared_median or median_nn, found {rule!r}")
    size = _middle(spacing)
    if not size > 0:
        size = _middle(spacing[spacing > 0])
    if not size > 0:
        raise InputError("expected two distinct points for an automatic voxel size, found none; give one with --scene.voxel-size")
    return factor * size


def _middle(values: Tensor) -> float:
    return float(values.kthvalue(max(1, len(values) // 2)).values) if values.numel() else 0.0
