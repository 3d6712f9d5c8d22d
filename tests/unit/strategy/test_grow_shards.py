"""Empty cells that several processes find together."""

import torch

from scene_experts.core.group import Alone
from scene_experts.core.shard import ShardedTable
from scene_experts.core.table import Table
from scene_experts.strategy.grow import empty_cells
from scene_experts.strategy.grow_shards import Candidates
from support.groups import run_group


def find(group: Alone) -> None:
    """Compare with `empty_cells` of the whole table."""
    rng = torch.Generator().manual_seed(0)
    features, taken = torch.rand(30, 12, generator=rng), torch.randint(-9, 9, (30, 3), generator=rng)
    parents = torch.randint(30, (200,), generator=rng).sort().values
    fine, g = 18 * torch.rand(200, 3, generator=rng).double() - 9, torch.rand(200, generator=rng)
    expected = empty_cells(features, taken, fine, parents, g, 4)
    assert expected is not None
    table = ShardedTable(Table({"feature": features}, {"cell": taken}), group)
    own, mine = torch.arange(group.rank, 30, group.size), parents % group.size == group.rank
    found = Candidates(table, features[own], taken[own], fine[mine], parents[mine] // group.size, g[mine], 4)
    cells, feature, strength = expected
    assert torch.equal(found.cells, cells) and torch.equal(found.strength, strength)
    chosen = torch.arange(0, len(cells), 2)
    owners = torch.arange(len(chosen)) % group.size
    assert torch.equal(found.features_of(chosen, owners), feature[chosen][owners == group.rank])
    none = Candidates(table, features[own], taken[own], fine[:0], parents[:0], g[:0], 4)
    assert len(none.cells) == 0 and none.features_of(chosen[:0], owners[:0]).shape == (0, 12)


def test_cells_and_features_are_those_of_the_whole_table():
    assert run_group(3, find, timeout=60) == [0, 0, 0]
    find(Alone())
