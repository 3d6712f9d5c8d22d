"""The cells of anchors in a compact file: an octree for each lattice, and one order for all.

Rows are coded along the Morton curve of the finest lattice. A cell of a coarser lattice lies where
its lowest corner does.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from scene_experts.core.errors import InputError
from scene_experts.core.reading.budget import Damaged
from scene_experts.core.reading.numbers import FARTHEST, number, whole_number
from scene_experts.files.anchors.data import AnchorData
from scene_experts.files.codec.numbers import STEP
from scene_experts.files.codec.reference import Ints
from scene_experts.files.codec.streams import SymbolReader, SymbolWriter
from scene_experts.files.formats.morton import AXIS_BITS, Keys, morton, unmorton

FARTHEST_CELL = 1 << 52  # coordinate of a cell
MOST_LATTICES = 64


@dataclass(frozen=True)
class Lattice:
    """One lattice and what lies on it."""

    level: int  # of detail; 0 without
    edge: float
    multiple: int  # cells of the finest lattice along an edge
    low: tuple[int, int, int]
    """Least cell coordinates."""
    count: int  # anchors
    distinct: int  # cells with anchors
    depth: int  # of the octree

    def plain(self) -> list[Any]:
        """This value as JSON values."""
        return [self.level, self.edge, self.multiple, list(self.low), self.count, self.distinct, self.depth]

    @classmethod
    def from_plain(cls, value: Any, most: int) -> Lattice:
        """The inverse of `plain`. Raises Damaged for values out of range."""
        level, edge, multiple, low, count, distinct, depth = value
        x, y, z = (whole_number(v, "a corner of the cells", -FARTHEST_CELL, FARTHEST_CELL) for v in low)
        return cls(
            whole_number(level, "a level", 0, MOST_LATTICES),
            number(edge, "the edge of a cell", 1e-30, FARTHEST),
            whole_number(multiple, "the multiple of a lattice", 1, 1 << AXIS_BITS),
            (x, y, z),
            whole_number(count, "the number of anchors", 1, most),
            whole_number(distinct, "the number of cells", 1, count),
            whole_number(depth, "the depth of an octree", 0, AXIS_BITS),
        )


@dataclass(frozen=True)
class AnchorPlaces:
    """Where N anchors are, in coding order, or along the Morton curve."""

    lattices: list[Lattice]
    cells: NDArray[np.int64]
    """[N, 3], of their own lattice"""
    lattice: NDArray[np.int64]
    """[N], index of their lattice"""
    keys: Keys
    """[N], Morton keys on the finest lattice"""
    fine: Ints
    """[N, 3], cells of the finest lattice, from 0 to 2^21"""

    def columns(self, origin: tuple[float, float, float]) -> dict[str, Tensor]:
        """xyz [N, 3], and with several lattices or a level of detail the column level [N]."""
        edges = np.array([lattice.edge for lattice in self.lattices] or [1.0])
        xyz = self.cells * edges[self.lattice][:, None] + np.array(origin)
        return {"xyz": torch.from_numpy(xyz.astype(np.float32))}

    def ordered(self, rows: NDArray[Any]) -> AnchorPlaces:
        """The places of rows [N]."""
        return AnchorPlaces(self.lattices, self.cells[rows], self.lattice[rows], self.keys[rows], self.fine[rows])

    def levels(self) -> Tensor:
        """The level of detail [N] int64 of each anchor."""
        return torch.from_numpy(np.array([lattice.level for lattice in self.lattices] or [0])[self.lattice])


def find_places(data: AnchorData) -> tuple[AnchorPlaces, NDArray[np.int64]]:
    """Where the anchors of a scene are, and the order [N] of its rows. Raises InputError for anchors
    on no lattice and for cells that span too much."""
    if data.cells is None:
        raise InputError("expected anchors on a lattice of known voxel size for a compact file, found others; use --format anchors")
    cells, n = data.cells.detach().cpu().numpy().astype(np.int64), len(data.cells)
    level = data.columns["level"].cpu().numpy().astype(np.int64) if data.edges else np.zeros(n, np.int64)
    edges, held = data.edges or (data.voxel,), np.unique(level)
    multiples = [_multiple(edges[j], edges[held[-1]]) for j in held]
    lattice = np.searchsorted(held, level)
    fine = cells * np.array(multiples or [1])[lattice][:, None]
    fine = from_zero(fine)
    keys = morton(fine)
    order = np.lexsort((lattice, keys))
    lattices = []
    for i, j in enumerate(held.tolist()):
        own = cells[lattice == i]
        corner = own.min(0)
        depth = int((own.max(0) - corner).max()).bit_length()
        x, y, z = corner.tolist()
        distinct = len(_count_runs(np.sort(keys[lattice == i]))[0])
        lattices.append(Lattice(j, float(edges[j]), multiples[i], (x, y, z), len(own), distinct, depth))
    return AnchorPlaces(lattices, cells[order], lattice[order], keys[order], fine[order].astype(np.int32)), order


def _multiple(edge: float, finest: float) -> int:
    found = round(edge / finest)
    if not 1 <= found < 1 << AXIS_BITS or abs(edge / finest - found) > 1e-6 * found:
        raise InputError("expected lattices whose cells divide each other for a compact file, found others; use --format anchors")
    return found


def from_zero(cells: NDArray[np.int64]) -> NDArray[np.int64]:
    """Cells relative to their least coordinates. Raises InputError for a wide scene."""
    low = cells.min(0) if len(cells) else np.zeros(3, np.int64)
    spread = int((cells.max(0) - low).max()) if len(cells) else 0
    if spread >= 1 << AXIS_BITS:
        raise InputError(f"expected a scene at most {1 << AXIS_BITS:,} voxels wide, found {spread + 1:,}; remove far anchors")
    return cells - low


def _count_runs(keys: Keys) -> tuple[Keys, NDArray[np.int64]]:
    """The different ones of ascending keys, and how many there are of each."""
    first = np.flatnonzero(np.concatenate([np.ones(min(len(keys), 1), bool), keys[1:] != keys[:-1]]))
    return keys[first], np.diff(first, append=len(keys))


def write_places(places: AnchorPlaces, writer: SymbolWriter) -> None:
    """Append the cells of all lattices."""
    for i, lattice in enumerate(places.lattices):
        keys = morton(places.cells[places.lattice == i] - np.array(lattice.low))
        distinct, counts = _count_runs(np.sort(keys))
        writer.cells(distinct.astype(np.int64), lattice.depth)
        if lattice.distinct < lattice.count:
            writer.symbols((counts - 1).astype(np.int32), np.zeros(len(counts), np.int32), np.full(len(counts), STEP, np.int32))


def read_places(lattices: list[Lattice], reader: SymbolReader) -> AnchorPlaces:
    """The places that `write_places` wrote. Raises Damaged for cells that do not fit."""
    own, index, fine = [np.zeros((0, 3), np.int64)], [np.zeros(0, np.int64)], [np.zeros((0, 3), np.int64)]
    for i, lattice in enumerate(lattices):
        keys = reader.cells(lattice.depth, lattice.distinct)
        if lattice.distinct < lattice.count:
            more = reader.symbols(np.zeros(len(keys), np.int32), np.full(len(keys), STEP, np.int32)).astype(np.int64)
            if more.min() < 0 or more.max() > lattice.count or more.sum() != lattice.count - lattice.distinct:
                raise Damaged("cells with another number of anchors")
            keys = np.repeat(keys, more + 1)
        cells = unmorton(keys.astype(np.uint64)) + np.array(lattice.low)
        own.append(cells)
        index.append(np.full(len(cells), i))
        if np.abs(cells).max(initial=0) * lattice.multiple > 1 << 60:
            raise Damaged("cells that are too far away")
        fine.append(cells * lattice.multiple)
    reader.finish()
    cells, lattice_of = np.concatenate(own), np.concatenate(index)
    try:
        found = from_zero(np.concatenate(fine))
        keys = morton(found)
    except InputError as error:
        raise Damaged(str(error)) from None
    order = np.lexsort((lattice_of, keys)) if len(lattices) > 1 else np.arange(len(keys))
    return AnchorPlaces(lattices, cells[order], lattice_of[order], keys[order], found[order].astype(np.int32))
