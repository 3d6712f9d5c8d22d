"""Tables that are divided among processes."""

import torch

from scene_experts.core import shard as shards
from scene_experts.core.group import Alone
from scene_experts.core.shard import ShardedTable, pack_rows, unpack_rows
from scene_experts.core.table import Table
from support.groups import run_group


def make_table(rows: int) -> Table:
    return Table({"value": torch.arange(rows).float()[:, None]}, {"cell": torch.arange(3 * rows).view(rows, 3)})


def divide(group: Alone) -> None:
    """Ten rows in three processes: remove three of them and collect the rest."""
    table = ShardedTable(make_table(10), group)
    assert table.params["value"][:, 0].tolist() == list(range(group.rank, 10, 3)) and table.total == 10
    gone = torch.isin(table.params["value"].detach()[:, 0], torch.tensor([0.0, 4.0, 6.0]))
    assert table.drop(gone) == 3 and table.total == 7
    values = torch.tensor([1.0, 2, 3, 5, 7, 8, 9])
    assert torch.equal(table.collect(table.params["value"])[:, 0], values if group.first else values[:0])
    assert torch.equal(table.whole_fact("cell")[:, 0], 3 * values.long())


def test_rows_keep_their_order_in_the_whole_table():
    assert run_group(3, divide, timeout=60) == [0, 0, 0]


def test_random_numbers_are_those_of_the_whole_table(monkeypatch):
    monkeypatch.setattr(shards, "BLOCK", 16)
    table = ShardedTable(make_table(50), Alone())
    whole = torch.rand(50, 3, generator=torch.Generator().manual_seed(1)).view(-1)
    rows = torch.arange(1, 50, 3)
    table.keep(torch.isin(torch.arange(50), rows))  # as if this process held every third row
    slots = torch.tensor([0, 4, 5, 20, 46])
    drawn = table.draw(torch.Generator().manual_seed(1), slots, 3)
    assert torch.equal(drawn, whole[rows[slots // 3] * 3 + slots % 3])


def test_packed_rows_come_back():
    for rows in (0, 1, 3):
        columns = [torch.rand(rows, 2, 3), torch.arange(rows), torch.ones(rows, dtype=torch.bool), torch.rand(rows, dtype=torch.float64)]
        assert all(torch.equal(a, b) for a, b in zip(columns, unpack_rows(pack_rows(columns), columns)))
