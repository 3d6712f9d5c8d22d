"""A table whose rows are divided among several processes.

Every row has a number: its place in the whole table, in the order in which one process would hold
the rows. A process holds its rows in the order of their numbers. The initial rows and later the new
ones go to the processes in turn, so that all hold about equally many.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import pairwise

import torch
from torch import Tensor

from scene_experts.core.group import Alone
from scene_experts.core.random import generator_on
from scene_experts.core.table import Table

NUMBER = "number"  # fact [n] int64 of a divided table; checkpoints do not have it
BLOCK = 1 << 16  # rows for which random numbers are drawn at once


class ShardedTable(Table):
    """The part of a table that this process holds. Every process must call the methods that
    exchange data in the same order."""

    def __init__(self, whole: Table, group: Alone) -> None:
        """Take over the columns and moments of `whole`, which is equal in all processes of `group`,
        and keep the rows of this process."""
        numbers = torch.arange(len(whole), device=whole.device)
        super().__init__({}, {**whole.facts, NUMBER: numbers}, whole.stats)
        self.params, self.averages, self._optimizer = whole.params, whole.averages, whole._optimizer
        self.group, self._total = group, len(numbers)
        self.keep(self.owned(numbers))

    @property
    def total(self) -> int:
        return self._total

    def append(self, new: dict[str, Tensor]) -> None:
        super().append(new)
        count = torch.tensor(len(new[NUMBER]), device=self.device)
        self.group.sum(count)
        self._total += int(count)

    def drop(self, mask: Tensor) -> int:
        """Remove the rows where `mask` [n] is true, and number the others anew. Returns how many
        were removed in all processes."""
        numbers = self.facts[NUMBER]
        gone = torch.cat(self.share(numbers[mask])).sort().values
        if len(gone):
            self.facts[NUMBER] = numbers - torch.searchsorted(gone, numbers)
            self.keep(~mask)
            self._total -= len(gone)
        return len(gone)

    def whole_fact(self, name: str) -> Tensor:
        return torch.cat(self.share(self.facts[name]))[torch.cat(self.share(self.facts[NUMBER])).argsort()]

    def owned(self, numbers: Tensor) -> Tensor:
        """Return which of the new rows with these `numbers` [n] this process gets, [n] bool."""
        return numbers % self.group.size == self.group.rank

    def share(self, rows: Tensor) -> list[Tensor]:
        """Return the rows [n, ...] of every process, in the order of the processes; n may
        differ."""
        return self.group.exchange([rows] * self.group.size)

    def collect(self, column: Tensor) -> Tensor:
        """Return the column [n, ...] of this process whole in process 0, [total, ...] on the CPU,
        and empty in the others."""
        numbers = self.facts[NUMBER]
        rest = [column[:0]] * (self.group.size - 1)
        parts = self.group.exchange([column, *rest])
        places = self.group.exchange([numbers, *([numbers[:0]] * (self.group.size - 1))])
        out = torch.empty(self.total if self.group.first else 0, *column.shape[1:], dtype=column.dtype)
        for place, part in zip(places, parts):
            out[place.cpu()] = part.detach().cpu()
        return out

    def draw(self, generator: torch.Generator, slots: Tensor, K: int) -> Tensor:
        """Return the random numbers in [0, 1) of some slots, [s]. On the CPU they are those of
        `torch.rand(total, K)`.

        generator: the same in all processes.  slots [s]: row * K + slot, ascending.
        """
        own = generator_on(slots.device, generator)
        wanted = self.facts[NUMBER][torch.div(slots, K, rounding_mode="floor")] * K + slots % K
        out = torch.empty(len(slots), device=slots.device)
        ends = torch.searchsorted(wanted, torch.arange(0, self.total + BLOCK, BLOCK, device=slots.device) * K).tolist()
        for block, (first, last) in enumerate(pairwise(ends)):
            drawn = torch.rand(min(BLOCK, self.total - block * BLOCK), K, generator=own, device=slots.device).view(-1)
            out[first:last] = drawn[wanted[first:last] - block * BLOCK * K]
        return out


def pack_rows(columns: Sequence[Tensor]) -> Tensor:
    """Return the bytes of the columns [n, ...] side by side, [n, B] uint8."""
    return torch.cat([c.detach().reshape(len(c), math.prod(c.shape[1:])).contiguous().view(torch.uint8) for c in columns], dim=1)


def unpack_rows(packed: Tensor, like: Sequence[Tensor]) -> list[Tensor]:
    """Return the columns that `pack_rows` has packed. `like` has their dtypes and the shapes of
    their rows."""
    out, place = [], 0
    for column in like:
        width = math.prod(column.shape[1:]) * column.element_size()
        part = packed[:, place : place + width].clone(memory_format=torch.contiguous_format)
        out.append(part.view(column.dtype).view(len(packed), *column.shape[1:]))
        place += width
    return out
