"""Rows that grow and shrink during training: parameters, facts and statistics kept aligned, with Adam's moments."""

from __future__ import annotations

from collections.abc import Callable
from typing import Self

import torch
from torch import Tensor, nn


class Table(nn.Module):
    """N rows of named columns; every value is [N, ...].

    `params` are learned, `facts` are fixed at birth (positions on the lattice, levels), `stats` are what density control counts. Growing
    and pruning go through `append` and `keep` alone, so no column and no optimiser moment can fall out of step with the rest.
    """

    params: nn.ParameterDict
    facts: dict[str, Tensor]
    stats: dict[str, Tensor]

    def __init__(self, params: dict[str, Tensor], facts: dict[str, Tensor], stats: dict[str, Tensor] | None = None) -> None:
        super().__init__()
        self.params = nn.ParameterDict({name: nn.Parameter(value) for name, value in params.items()})
        self.facts = dict(facts)
        self.stats = dict(stats or {})
        self._optimizer: torch.optim.Optimizer | None = None
        lengths = {name: value.shape[0] for name, value in self.columns().items()}
        if len(set(lengths.values())) > 1:
            raise ValueError(f"expected columns of one length, found {lengths}")

    def __len__(self) -> int:
        return next(iter(self.columns().values())).shape[0]

    def _apply(self, fn: Callable[[Tensor], Tensor], recurse: bool = True) -> Self:
        """What `.to(...)` and the like do: move parameters, facts and statistics alike. Integer columns keep their dtype."""
        super()._apply(fn, recurse)
        self.facts = {name: fn(value) for name, value in self.facts.items()}
        self.stats = {name: fn(value) for name, value in self.stats.items()}
        return self

    def columns(self) -> dict[str, Tensor]:
        """Parameters and facts by name (not the statistics): what a new row must have."""
        return {**dict(self.params.items()), **self.facts}

    def attach(self, optimizer: torch.optim.Optimizer) -> None:
        """Keep the moments of `optimizer` (Adam or the like) aligned from now on; it must hold each parameter in a group of its own."""
        for name, parameter in self.params.items():
            if not any(len(group["params"]) == 1 and group["params"][0] is parameter for group in optimizer.param_groups):
                raise ValueError(f"expected an optimiser group that holds column '{name}' alone, found none")
        self._optimizer = optimizer

    @property
    def device(self) -> torch.device:
        """Where the columns are."""
        return next(iter(self.columns().values())).device

    @torch.no_grad()
    def append(self, new: dict[str, Tensor]) -> None:
        """Add rows. `new` has exactly the table's columns; statistics and Adam's moments of the new rows start at zero.

        Raises KeyError naming both sets of columns when they differ.
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

    @torch.no_grad()
    def keep(self, mask: Tensor) -> None:
        """Keep the rows where `mask` [N] (bool) is true, in order."""
        if mask.dtype != torch.bool or mask.shape != (len(self),):
            raise ValueError(f"expected a bool mask of shape ({len(self)},), found {mask.dtype} {tuple(mask.shape)}")
        rows = mask.nonzero().squeeze(1)
        for name in list(self.params):
            self._replace(name, self.params[name].data.index_select(0, rows), lambda m: m.index_select(0, rows))
        self.facts = {name: value.index_select(0, rows) for name, value in self.facts.items()}
        self.stats = {name: value.index_select(0, rows) for name, value in self.stats.items()}

    @torch.no_grad()
    def assign(self, name: str, value: Tensor) -> None:
        """Overwrite a parameter column and clear its moments."""
        if value.shape != self.params[name].shape:
            raise ValueError(f"expected shape {tuple(self.params[name].shape)} for column '{name}', found {tuple(value.shape)}")
        self._replace(name, value.clone(), torch.zeros_like)

    @torch.no_grad()
    def overwrite(self, rows: Tensor, values: dict[str, Tensor], clear: bool = False) -> None:
        """Overwrite `rows` [R] (each once) of some parameter columns in place; `clear`: their moments, in every column, begin anew."""
        for name, value in values.items():
            self.params[name].index_copy_(0, rows, value.to(self.params[name].dtype))
        if not clear or self._optimizer is None:
            return
        for parameter in self.params.values():
            for item in self._optimizer.state.get(parameter, {}).values():
                if isinstance(item, Tensor) and item.dim() > 0:
                    item.index_fill_(0, rows, 0.0)

    def _replace(self, name: str, value: Tensor, edit) -> None:
        """Put a fresh parameter (no gradient) in place, moments edited by `edit`: Adam's step counter is kept."""
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
