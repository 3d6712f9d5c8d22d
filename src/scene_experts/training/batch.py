"""How the views of a batch become one optimiser step, in one process or in several.

The loss of a batch is the mean of the losses of its B views. Each view is differentiated alone and
with weight 1, so that its 2D gradients have the size that densification expects. The gradients of
the parameters are then added up over the views and divided by B.

Process r of W sees the views r, r + W, ... of a batch. All processes have the same scene, the same
optimiser and the same random numbers, and make the same decisions. They exchange gradients after
each batch, and the statistics for densification when somebody reads them.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from scene_experts.core.errors import InputError, RunError
from scene_experts.core.group import Alone
from scene_experts.core.types import Camera, Decoded, Mode, Render
from scene_experts.scene import Cull, Scene
from scene_experts.training.state import Training


class Direct:
    """One process: gradients add up in the parameters, and statistics in the table."""

    def __init__(self, training: Training, group: Alone, stop: list[str]) -> None:
        """stop: reasons to stop, which a signal handler may append to."""
        self.training, self.group, self.stop = training, group, stop
        self.seen: list[Tensor | None] = []  # decoded rows of each view; None: the loss reaches all rows

    @property
    def stopping(self) -> bool:
        """Whether the training stops after this iteration. Every process gets the same answer."""
        return bool(self.stop)

    def start(self) -> None:
        """Make the state of all processes equal, before the first iteration."""

    def scene_of(self, cameras: Sequence[Camera | None], step: int, mode: Mode, cull: Cull) -> Scene:
        """Return the scene from which this process draws its view. Every process must call this.

        cameras: One for each process; None for a process that draws nothing. With TRAIN, process r
        draws as iteration step + r.
        """
        return self.training.scene

    def tensors(self) -> dict[str, Tensor]:
        """Return the tensors of a checkpoint, in process 0. Every process must call this, after
        `complete`."""
        return self.training.tensors()

    def add(self, decoded: Decoded, render: Render, number: int) -> None:
        """Add a view of this process, after its backward pass. number: its iteration."""
        self._note_rows(decoded)
        self.training.cfg.growth.observe(self.training.scene, decoded, render, number)

    def finish(self) -> None:
        """Complete the gradients of the batch, after its last view."""
        if self.training.cfg.batch > 1:
            for gradient in _gradients(self.training):
                gradient /= self.training.cfg.batch
        self.training.scene.end_batch(self.training.cfg.batch)

    def complete(self) -> None:
        """Complete the statistics of the table, before they are read or saved."""

    def limit(self, cap: int, measured: bool) -> int:
        """Return the limit on the number of rows: the smallest of all processes. 0 means no limit.

        measured: Whether the limit depends on the memory of the process, and may differ between
        processes.
        """
        return cap

    def compare(self, rows: int, edited: bool) -> None:
        """Raise RunError if the processes have different numbers of rows after densification
        (`edited`)."""

    def rows(self) -> Tensor | None:
        """Return the rows that a view of the batch has decoded, [A] int64 without duplicates; None
        if the loss reaches all rows."""
        seen, self.seen = self.seen, []
        if len(seen) == 1:
            return seen[0]
        known = [rows for rows in seen if rows is not None]
        return torch.cat(known).unique() if len(known) == len(seen) else None

    def _note_rows(self, decoded: Decoded) -> None:
        cfg = self.training.cfg
        if cfg.sparse_adam:
            self.seen.append(None if cfg.loss.reaches_every_row(decoded) else decoded.rows)


class Reduced(Direct):
    """Several processes: the sums of each process are added up, in any order."""

    def __init__(self, training: Training, group: Alone, stop: list[str]) -> None:
        super().__init__(training, group, stop)
        self.agreed = False  # whether a process has asked to stop
        self.pending: dict[str, Tensor] = {}  # statistics of this process that were not added up yet

    @property
    def stopping(self) -> bool:
        return self.agreed

    def start(self) -> None:
        training = self.training
        found = self.group.gather_values((training.step, len(training.scene.table), training.capture_id))
        if len(set(found)) > 1:
            raise InputError(
                f"expected the same capture and the same checkpoint in all processes, found iterations {[step for step, *_ in found]} and "
                f"rows {[rows for _, rows, _ in found]}; give --data and --out in folders that all machines share"
            )
        self.group.copy_from_first([value for name, value in training.tensors().items() if not name.startswith(("rng.", "queue"))])

    def add(self, decoded: Decoded, render: Render, number: int) -> None:
        self._note_rows(decoded)
        self.pending = self._observe(self.training.scene, decoded, render, number, self.pending)

    def finish(self) -> None:
        gradients = _gradients(self.training)
        flag = gradients[0].new_full((1,), float(bool(self.stop)))
        flat = _flatten([*gradients, flag])
        self.group.sum(flat)
        self._use(flat)

    def complete(self) -> None:
        if not self.pending:
            return
        flat = _flatten(list(self.pending.values()))
        self.group.sum(flat)
        self._add_statistics(self.pending, flat)
        self.pending = {}

    def limit(self, cap: int, measured: bool) -> int:
        return self.group.smallest(cap) if measured else cap

    def compare(self, rows: int, edited: bool) -> None:
        found = self.group.gather_values(rows) if edited else []
        if len(set(found)) > 1:
            raise RunError(
                f"expected equal scenes in all processes, found {found} rows at iteration {self.training.step}; "
                "use machines with the same processor or GPU, or --deterministic, and continue with --resume"
            )

    def rows(self) -> Tensor | None:
        table, seen = self.training.scene.table, self.seen
        self.seen = []
        chosen = torch.zeros(len(table) + 1, dtype=torch.uint8, device=table.device)  # the last one: all rows
        for rows in seen:
            chosen[len(table) if rows is None else rows] = 1
        self.group.sum(chosen)
        return None if chosen[-1] else chosen[:-1].nonzero().squeeze(1)

    def _observe(self, scene: Scene, decoded: Decoded, render: Render, number: int, into: dict[str, Tensor]) -> dict[str, Tensor]:
        """Add a view, that of iteration `number`, to the statistics `into` in place of those of the
        table, and return them.

        Where this view does not count but another of the same turn does, they are zeros: all
        processes have the same columns.
        """
        table, growth = scene.table, self.training.cfg.growth
        kept, table.stats = table.stats, into
        try:
            growth.observe(scene, decoded, render, number)
            first = number - self.group.rank
            for other in range(first, first + self.group.size):
                if not table.stats:
                    growth.observe(scene, decoded, render, other)
                    for total in table.stats.values():
                        total.zero_()
            return table.stats
        finally:
            table.stats = kept

    def _add_statistics(self, like: dict[str, Tensor], flat: Tensor) -> None:
        """Add `flat`, which has the columns of `like` in a row, to the statistics of the table."""
        stats = self.training.scene.table.stats
        for (name, value), part in zip(like.items(), flat.split([value.numel() for value in like.values()])):
            if name not in stats:
                stats[name] = torch.zeros_like(value)
            stats[name] += part.view_as(value)

    def _use(self, flat: Tensor) -> None:
        """Take the gradients and the request to stop from their sums over the batch."""
        parameters = _parameters(self.training)
        *parts, flag = flat.split([t.numel() for t in parameters] + [1])
        flat[:-1] /= self.training.cfg.batch
        for parameter, part in zip(parameters, parts):
            parameter.grad = part.view_as(parameter)
        self.training.scene.end_batch(self.training.cfg.batch)
        if flag:
            self.agreed = True
            if not self.stop:
                self.stop.append("SIGTERM")  # another process was asked to stop


class Ordered(Reduced):
    """One or several processes: gradients and statistics are added in the order of the views, so
    that the bits of the sums do not depend on the number of processes."""

    def __init__(self, training: Training, group: Alone, stop: list[str]) -> None:
        super().__init__(training, group, stop)
        self.total: Tensor | None = None

    def add(self, decoded: Decoded, render: Render, number: int) -> None:
        self._note_rows(decoded)
        gradients = _gradients(self.training)
        flag = gradients[0].new_full((1,), float(bool(self.stop)))
        for part in self.group.gather(_flatten([*gradients, flag])):
            self.total = part.clone() if self.total is None else self.total.add_(part)
        for parameter in _parameters(self.training):
            parameter.grad = None
        observed = self._observe(self.training.scene, decoded, render, number, {})
        if observed:
            for part in self.group.gather(_flatten(list(observed.values()))):
                self._add_statistics(observed, part)

    def finish(self) -> None:
        assert self.total is not None
        total, self.total = self.total, None
        self._use(total)


def make_exchange(training: Training, group: Alone, stop: list[str], deterministic: bool) -> Direct:
    """Return the exchange for a training. Raises InputError unless the number of processes divides
    the batch."""
    check_batch(training.cfg.batch, group.size)
    if deterministic and training.cfg.batch > 1:
        return Ordered(training, group, stop)
    return Direct(training, group, stop) if group.size == 1 else Reduced(training, group, stop)


def check_batch(batch: int, processes: int) -> None:
    """Raise InputError, which names --batch, unless the processes can share the views of a batch
    evenly."""
    if batch % processes:
        wanted = -(-batch // processes) * processes
        raise InputError(f"expected a --batch that {processes} processes share evenly, found {batch}; give for example --batch {wanted}")


def _parameters(training: Training) -> list[Tensor]:
    return [p for group in training.optimizer.param_groups for p in group["params"] if p.requires_grad]


def _gradients(training: Training) -> list[Tensor]:
    """Return the gradients of all parameters in the order of the optimiser. A parameter without one
    gets zeros."""
    found = []
    for parameter in _parameters(training):
        if parameter.grad is None:
            parameter.grad = torch.zeros_like(parameter)
        found.append(parameter.grad)
    return found


def _flatten(tensors: list[Tensor]) -> Tensor:
    return torch.cat([tensor.reshape(-1) for tensor in tensors])
