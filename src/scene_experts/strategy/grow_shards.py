"""Empty cells for new anchors, found by several processes that each hold a part of the anchors.

The processes exchange the keys of the cells and the largest gradient in each (16 bytes per
candidate). The features of a new anchor travel only to the process that gets it. The results are
those of `grow.empty_cells` for the whole table: maxima do not depend on any order.
"""

from __future__ import annotations

import torch
from torch import Tensor

from scene_experts.core.shard import ShardedTable
from scene_experts.geometry.voxel import AXIS_LIMIT, coarsen, in_set, pack, scatter_max, unpack

_COLUMNS = 8  # columns of the features that are copied at once


class Candidates:
    """Empty cells that contain candidate points of any process. Every process has the same `cells`
    and `strength`."""

    cells: Tensor  # [n, 3] int64, in the order of their keys
    strength: Tensor  # [n], the largest gradient per cell

    def __init__(self, table: ShardedTable, features: Tensor, taken: Tensor, fine: Tensor, parents: Tensor, g: Tensor, factor: int) -> None:
        """Find the cells. The arguments are those of `grow.empty_cells`, for the anchors of this
        process."""
        self.table, self.features = table, features
        fine = torch.floor(fine + 0.5)
        inside = (fine.abs() < AXIS_LIMIT - factor).all(1)
        self.parents = parents[inside]
        self.keys, self.group = torch.unique(pack(coarsen(fine[inside].long(), factor)), return_inverse=True)  # of this process
        every = torch.cat(table.share(self.keys))
        keys, place = torch.unique(every, return_inverse=True)
        best = torch.cat(table.share(scatter_max(g[inside, None], self.group, len(self.keys))))
        used = in_set(keys, pack(coarsen(taken, factor))).int()
        table.group.sum(used)
        free = (used == 0).nonzero().squeeze(1)
        self.found, self.strength = keys[free], scatter_max(best, place, len(keys))[free].squeeze(1)
        self.cells = unpack(self.found)

    def features_of(self, chosen: Tensor, owners: Tensor) -> Tensor:
        """Return the features of the new anchors that this process gets, [m, F]: the maximum over
        the parents of all points in the cell.

        chosen [c]: the cells that become anchors, ascending.  owners [c]: their processes.
        """
        keys, group = self.found[chosen], self.table.group
        mine = torch.searchsorted(keys, self.keys).clamp_max(max(len(keys) - 1, 0))
        known = keys[mine] == self.keys if len(keys) else torch.zeros_like(self.keys, dtype=torch.bool)
        slot = torch.full_like(self.keys, -1)
        slot[known] = torch.arange(int(known.sum()), device=slot.device)
        target = slot[self.group]
        here = (target >= 0).nonzero().squeeze(1)
        parents, target, count = self.parents[here], target[here], int(known.sum())
        parts = self.features.split(_COLUMNS, dim=1)
        feature = torch.cat([scatter_max(part.index_select(0, parents), target, count) for part in parts], dim=1)
        to = owners[mine[known]] if count else slot[:0]
        places = group.exchange([mine[known][to == rank] for rank in range(group.size)])
        sent = group.exchange([feature[to == rank] for rank in range(group.size)])
        own = (owners == group.rank).nonzero().squeeze(1)
        return scatter_max(torch.cat(sent), torch.searchsorted(own, torch.cat(places)), len(own))
