"""A table whose rows are added and removed during training. Parameters, facts, statistics and
Adam's moments stay aligned."""

from __future__ import annotations

from collections.abc import Callable
from typing import Self

import torch
from torch import Tensor, nn


class Table(nn.Module):
    """A table of N rows with named columns [N, ...].

    `params` are learned. `facts` are constant for each row (positions on the lattice, levels).
    `stats` are the statistics for densification. `averages` are averages of the parameters over the
    training, if there are any. Rows are added only by `append` and removed only by `keep`, which
    keep all columns and moments aligned.
    """

    params: nn.ParameterDict
    facts: dict[str, Tensor]
    stats: dict[str, Tensor]
    averages: dict[str, Tensor]
    version: int
    """A number that changes whenever a parameter becomes another object or moves."""

    def __init__(self, params: dict[str, Tensor], facts: dict[str, Tensor], stats: dict[str, Tensor] | None = None) -> None:
        super().__init__()
        self.params = nn.ParameterDict({name: nn.Parameter(value) for name, value in params.items()})
        self.facts = dict(facts)
        self.stats = dict(stats or {})
        self.averages = {}
        self.version = 0
        self._optimizer: torch.optim.Optimizer | None = None
        lengths = {name: value.shape[0] for name, value in self.columns().items()}
        if len(set(lengths.values())) > 1:
            raise ValueError(f"expected columns of one length, found {lengths}")

    def __len__(self) -> int:
        for value in self.facts.values():  # quicker than the parameters
            return value.shape[0]
        return next(iter(self.params.values())).shape[0]

    @property
    def total(self) -> int:
        """Number of rows in all processes."""
        return len(self)

    def _apply(self, fn: Callable[[Tensor], Tensor], recurse: bool = True) -> Self:
        """Apply `.to(...)` and similar methods to parameters, facts and statistics. Integer columns
        keep their dtype."""
        super()._apply(fn, recurse)
        self.version += 1
        self.facts = {name: fn(value) for name, value in self.facts.items()}
        self.stats = {name: fn(value) for name, value in self.stats.items()}
        self.averages = {name: fn(value) for name, value in self.averages.items()}
        return self

    def columns(self) -> dict[str, Tensor]:
        """Return parameters and facts by name, without statistics. New rows must have these
        columns."""
        return {**dict(self.params.items()), **self.facts}

    def attach(self, optimizer: torch.optim.Optimizer) -> None:
        """Keep the moments of `optimizer` aligned with the rows from now on.

        Raises ValueError if a parameter does not have its own parameter group.
        """
        for name, parameter in self.params.items():
            if not any(len(group["params"]) == 1 and group["params"][0] is parameter for group in optimizer.param_groups):
                raise ValueError(f"expected an optimiser group that holds column '{name}' alone, found none")
        self._optimizer = optimizer

    @property
    def device(self) -> torch.device:
        """The device of the columns."""
        return next(iter(self.columns().values())).device

    @torch.no_grad()
    def append(self, new: dict[str, Tensor]) -> None:
        """Add rows. Their statistics and Adam's moments start at zero, their averages at their
        values.

        `new` must have the same columns as the table. Raises KeyError, which names both sets of
        columns, if they differ.
        """
        if new.keys() != self.columns().keys():
            raise KeyError(f"expected columns {sorted(self.columns())}, found {sorted(new)}")
        count = next(iter(new.values())).shape[0]
        for name in list(self.params):
            old = self.params[name]
            value = torch.cat([old.data, new[name].to(old.dtype)])
            self._replace(name, value, lambda m: torch.cat([m, m.new_zeros(count, *m.shape[1:])]))
        for name, old in self.facts.items():
            self.facts[name] = torch.cat([old, new[name].to(old.dtype)])
        for name, old in self.stats.items():
            self.stats[name] = torch.cat([old, old.new_zeros(count, *old.shape[1:])])
        for name, old in self.averages.items():
            self.averages[name] = torch.cat([old, new[name].to(old.dtype)])

    @torch.no_grad()
    def keep(self, mask: Tensor) -> None:
        """Keep the rows where `mask` [N] (bool) is true, in order. Raises ValueError for another
        dtype or shape."""
        if mask.dtype != torch.bool or mask.shape != (len(self),):
            raise ValueError(f"expected a bool mask of shape ({len(self)},), found {mask.dtype} {tuple(mask.shape)}")
        rows = mask.nonzero().squeeze(1)
        for name in list(self.params):
            self._replace(name, self.params[name].data.index_select(0, rows), lambda m: m.index_select(0, rows))
        self.facts = {name: value.index_select(0, rows) for name, value in self.facts.items()}
        self.stats = {name: value.index_select(0, rows) for name, value in self.stats.items()}
        self.averages = {name: value.index_select(0, rows) for name, value in self.averages.items()}

    def whole_fact(self, name: str) -> Tensor:
        """Return a fact of the rows of all processes, [total, ...]. Every process must call
        this."""
        return self.facts[name]

    def drop(self, mask: Tensor) -> int:
        """Remove the rows where `mask` [N] (bool) is true. Returns how many were removed in all
        processes."""
        gone = int(mask.sum())
        if gone:
            self.keep(~mask)
        return gone

    @torch.no_grad()
    def assign(self, name: str, value: Tensor) -> None:
        """Overwrite a parameter column and its average, and set its moments to zero. Raises
        ValueError if the shapes differ."""
        if value.shape != self.params[name].shape:
            raise ValueError(f"expected shape {tuple(self.params[name].shape)} for column '{name}', found {tuple(value.shape)}")
        self._replace(name, value.clone(), torch.zeros_like)
        if name in self.averages:
            self.averages[name] = value.clone()

    @torch.no_grad()
    def overwrite(self, rows: Tensor, values: dict[str, Tensor], clear: bool = False) -> None:
        """Overwrite rows of some parameter columns in place, and their averages.

        Args:
            rows: [R] int64 without duplicates.
            values: [R, ...] new values by column.
            clear: Set the moments of these rows to zero in all parameter columns.
        """
        for name, value in values.items():
            self.params[name].index_copy_(0, rows, value.to(self.params[name].dtype))
            if name in self.averages:
                self.averages[name].index_copy_(0, rows, value.to(self.averages[name].dtype))
        if not clear or self._optimizer is None:
            return
        for parameter in self.params.values():
            for item in self._optimizer.state.get(parameter, {}).values():
                if isinstance(item, Tensor) and item.dim() > 0:
                    item.index_fill_(0, rows, 0.0)

    def _replace(self, name: str, value: Tensor, edit) -> None:
        """Replace a parameter with a new one without gradient. `edit` changes the moments; Adam's
        step counter is kept."""
        self.version += 1
        old = self.params[name]
        new = nn.Parameter(value)
        self.params[name] = new
        if self._optimizer is None:
            return
        for group in self._optimizer.param_groups:
            if group["params"][0] is old:
                group["params"][0] = new
        state = self._optimizer.state.pop(old, None)
        if state is not None:
            self._optimizer.state[new] = {
                key: edit(item) if isinstance(item, Tensor) and item.dim() > 0 else item for key, item in state.items()
            }
