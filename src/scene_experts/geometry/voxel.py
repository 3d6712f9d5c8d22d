"""The integer lattice of the anchors: cells are int64 triples, so that no question about a cell depends on rounding or on the device.

Scaffold-GS keeps float positions and rounds them again for each cell size; anchors then sit on rounding ties, and float32 and float64
disagree for up to a fifth of them. Here a point is rounded once, in float64, and coarser cells follow by integer arithmetic.
"""

from __future__ import annotations

from typing import Literal

import torch
from torch import Tensor

from scene_experts.core.errors import InputError
from scene_experts.geometry.neighbours import knn_d2, median_neighbour_distance, nearest

VoxelRule = Literal["squared_median", "median_nn"]
VoxelChoice = Literal["neighbours", "squared_median", "median_nn"]
AXIS_BITS = 21
AXIS_LIMIT = 1 << (AXIS_BITS - 1)  # cells of an axis lie in [-AXIS_LIMIT, AXIS_LIMIT)


def to_lattice(points: Tensor, size: float) -> Tensor:
    """Cells [N, 3] int64 of `points` [N, 3] (world units) for cells of edge `size`: round(point / size), halves to even, in float64.

    Raises InputError for coordinates that are not finite or whose cell number does not fit (beyond 2^53 no float64 is exact).
    """
    if not size > 0:
        raise InputError(f"expected a voxel size above 0, found {size}; give one with --scene.voxel-size, or 0 for the automatic one")
    cells = torch.round(points.detach().to(torch.float64) / size)
    if not bool((cells.abs() < 2.0**53).all()):
        raise InputError(
            f"expected points that are finite and near enough for voxels of {size:g}, found others; remove far outliers or give a larger "
            f"--scene.voxel-size"
        )
    return cells.to(torch.int64)


def coarsen(cells: Tensor, m: int) -> Tensor:
    """Cells m times as large: floor((i + m/2) / m) in integers, so halves go up; for m = 1 the cells themselves."""
    if m < 1:
        raise ValueError(f"the factor between cell sizes must be at least 1, found {m}")
    if m & (m - 1) == 0:
        return (2 * cells + m) >> m.bit_length()  # the same, several times faster
    return torch.div(2 * cells + m, 2 * m, rounding_mode="floor")


def pack(cells: Tensor) -> Tensor:
    """One int64 key [N] per cell [N, 3], 21 bits an axis; keys sort as (x, y, z) do. InputError for a cell outside [-2^20, 2^20)."""
    if cells.numel() and not bool(((cells >= -AXIS_LIMIT) & (cells < AXIS_LIMIT)).all()):
        found = int(cells.abs().max())
        raise InputError(
            f"expected voxel numbers within {AXIS_LIMIT:,} of the origin, found {found:,}; remove far outliers or give a larger "
            f"--scene.voxel-size"
        )
    x, y, z = (cells + AXIS_LIMIT).unbind(-1)
    return (x << (2 * AXIS_BITS)) | (y << AXIS_BITS) | z


def unpack(keys: Tensor) -> Tensor:
    """Cells [N, 3] of keys [N], the inverse of `pack`."""
    mask = (1 << AXIS_BITS) - 1
    return torch.stack([(keys >> (2 * AXIS_BITS)) & mask, (keys >> AXIS_BITS) & mask, keys & mask], dim=-1) - AXIS_LIMIT


def unique_cells(cells: Tensor) -> tuple[Tensor, Tensor]:
    """The different cells [U, 3] in the order of (x, y, z), and for each of `cells` [N, 3] which one it is [N]."""
    keys, inverse = torch.unique(pack(cells), return_inverse=True)
    return unpack(keys), inverse


def in_set(keys: Tensor, others: Tensor) -> Tensor:
    """Whether each of `keys` [N] occurs among `others` [M] (any order, repeats allowed), [N] bool."""
    if not others.numel() or not keys.numel():
        return torch.zeros_like(keys, dtype=torch.bool)
    if len(keys) < len(others):  # sort the few, look the many up
        ordered, place = keys.unique(return_inverse=True)
        at = torch.searchsorted(ordered, others).clamp_max(len(ordered) - 1)
        hit = torch.zeros_like(ordered, dtype=torch.bool)
        hit[at[ordered[at] == others]] = True
        return hit[place]
    ordered = others.sort().values
    at = torch.searchsorted(ordered, keys).clamp_max(len(ordered) - 1)
    return ordered[at] == keys


def scatter_max(values: Tensor, group: Tensor, groups: int) -> Tensor:
    """Element-wise maximum [groups, F] over the rows of `values` [P, F] with each `group` [P] number; 0 for a group with no row."""
    out = values.new_zeros((groups, values.shape[1]))
    return out.scatter_reduce(0, group[:, None].expand_as(values), values, reduce="amax", include_self=False)


def voxel_size(points: Tensor, rule: VoxelChoice) -> float:
    """The lattice's edge by rule, from points [P, 3], in their unit: a quarter of their median neighbour distance, or as `auto_voxel`.

    Raises InputError if no two points differ.
    """
    if rule != "neighbours":
        return auto_voxel(points, rule)
    spacing = median_neighbour_distance(points)
    return 0.25 * spacing if spacing > 0 else auto_voxel(points, "median_nn", 0.25)  # more than half of the points coincide


def auto_voxel(points: Tensor, rule: VoxelRule = "squared_median", factor: float = 1.0) -> float:
    """A voxel size from the spacing of `points` [P, 3], times `factor`.

    "squared_median" is what Scaffold-GS computes: the int(P / 2)-th smallest mean *squared* distance to 3 neighbours, without a root, so
    it depends on the unit quadratically. "median_nn" is what its documentation says: the median distance to the nearest neighbour, in
    world units. Where more than half the points coincide, the value is taken over the points that have a spacing.
    Raises InputError if no two points differ.
    """
    if rule == "squared_median":
        spacing = knn_d2(points)
    elif rule == "median_nn":
        spacing = nearest(points, 1)[0].flatten().sqrt()
    else:
        raise ValueError(f"expected the rule squared_median or median_nn, found {rule!r}")
    size = _middle(spacing)
    if not size > 0:
        size = _middle(spacing[spacing > 0])
    if not size > 0:
        raise InputError("expected two different points for an automatic voxel size, found none; give one with --scene.voxel-size")
    return factor * size


def _middle(values: Tensor) -> float:
    return float(values.kthvalue(max(1, len(values) // 2)).values) if values.numel() else 0.0
