"""How the views of a batch become one optimiser step when the rows of the table are divided among
the processes (`--shard`).

Each process holds some rows with their moments and statistics (`core/shard.py`); all hold the same
networks. The processes take turns of W views, one view each. In a turn, each process culls its rows
for all W views and sends the visible ones to the process that draws the view. That process puts
them into a table for this view alone, in the order of their numbers. The gradients and statistics
of the rows travel back and are added in the order of the views. If the gradients of the networks
are ordered too, no bit of the results depends on the number of processes. They are those of
`batch.Ordered`, but for the rounding that `rows` describes.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from scene_experts.core.errors import InputError
from scene_experts.core.group import Alone
from scene_experts.core.shard import NUMBER, ShardedTable, pack_rows, unpack_rows
from scene_experts.core.table import Table
from scene_experts.core.types import Camera, Decoded, Mode, Render
from scene_experts.scene import Cull
from scene_experts.scene.anchors.scene import AnchorScene
from scene_experts.training.batch import Reduced
from scene_experts.training.config import Train
from scene_experts.training.state import Training

AT_HOME = ("cell",)  # facts that drawing does not need


class Sharded(Reduced):
    """Several processes, or one, that each hold a part of the rows."""

    scene: AnchorScene
    view: AnchorScene | None  # the rows of the view that this process draws
    table: ShardedTable

    def __init__(self, training: Training, group: Alone, stop: list[str], ordered: bool) -> None:
        """ordered: add the gradients of the networks in the order of the views too."""
        super().__init__(training, group, stop)
        self.scene, self.ordered = training.scene, ordered  # type: ignore[assignment]  # `check_shard` has made sure
        self.total: Tensor | None = None  # the networks' gradients and the request to stop
        self.decoded: Tensor | None = None  # rows that a view has decoded, [n] bool
        self.view = None

    def start(self) -> None:
        """Make the scenes of all processes equal, and keep the rows of this process."""
        super().start()
        self.scene.table = self.table = ShardedTable(self.scene.table, self.group)

    def scene_of(self, cameras: Sequence[Camera | None], step: int, mode: Mode, cull: Cull) -> AnchorScene:
        """Return the rows that the camera of this process sees, as a scene. Every process must call
        this.

        cameras: One for each process; None for a process that draws nothing. With TRAIN, process r
        draws as iteration step + r.
        """
        table, size = self.scene.table, self.group.size
        columns = {name: column.detach() for name, column in table.columns().items() if name not in AT_HOME}
        none = torch.zeros(0, dtype=torch.int64, device=table.device)
        numbers = [step + (rank if mode is Mode.TRAIN else 0) for rank in range(size)]
        self.asked = [none if c is None else self.scene.visible(c, number, mode, cull) for c, number in zip(cameras, numbers)]
        parts = self.group.exchange([pack_rows([c.index_select(0, rows) for c in columns.values()]) for rows in self.asked])
        self.counts = [len(part) for part in parts]
        got = dict(zip(columns, unpack_rows(torch.cat(parts), list(columns.values()))))
        del parts
        self.order = got.pop(NUMBER).argsort()
        got = {name: column.index_select(0, self.order) for name, column in got.items()}
        params = {name: got.pop(name) for name in table.params}
        self.view = self.scene.with_table(Table(params, got))
        return self.view

    @torch.no_grad()
    def add(self, decoded: Decoded, render: Render, number: int) -> None:
        """Send the gradients and statistics of the rows of the view home, and add those that arrive
        to the rows of this process."""
        assert self.view is not None
        here, table, cfg = self.view.table, self.scene.table, self.training.cfg
        stats = self._observe(self.view, decoded, render, number, {})
        chosen = torch.zeros(len(here), dtype=torch.bool, device=here.device)
        chosen[decoded.rows] = True
        gradients = [torch.zeros_like(p) if p.grad is None else p.grad for p in here.params.values()]
        self.view = None
        sent = [*gradients, *stats.values(), chosen]
        packed = pack_rows(sent)
        arrived = torch.empty_like(packed).index_copy_(0, self.order, packed)
        del packed, gradients, here
        for rows, part in zip(self.asked, self.group.exchange(list(arrived.split(self.counts)))):
            columns = iter(unpack_rows(part, sent))
            for parameter in table.params.values():
                if parameter.grad is None:
                    parameter.grad = torch.zeros_like(parameter)
                parameter.grad.index_add_(0, rows, next(columns))
            for name, like in stats.items():
                if name not in table.stats:
                    table.stats[name] = like.new_zeros(len(table), *like.shape[1:])
                table.stats[name].index_add_(0, rows, next(columns))
            if cfg.sparse_adam:
                self.decoded = torch.zeros(len(table), dtype=torch.bool, device=table.device) if self.decoded is None else self.decoded
                self.decoded[rows[next(columns)]] = True
        self._add_networks()

    def finish(self) -> None:
        assert self.total is not None
        if not self.ordered:
            self.group.sum(self.total)
        batch = self.training.cfg.batch
        *parts, flag = self.total.split([p.numel() for p in self._networks()] + [1])
        for parameter, part in zip(self._networks(), parts):
            parameter.grad = part.view_as(parameter) / batch
        for parameter in self.scene.table.params.values():
            if parameter.grad is None:
                parameter.grad = torch.zeros_like(parameter)
            parameter.grad /= batch
        self.scene.end_batch(batch)
        self.total = None
        if flag:
            self.agreed = True
            if not self.stop:
                self.stop.append("SIGTERM")  # another process was asked to stop

    def complete(self) -> None:
        """Nothing is left to do: statistics travel with the gradients."""

    def rows(self) -> Tensor | None:
        """Return the rows of this process that the optimiser moves: those that a view has decoded
        with `sparse_adam`, otherwise all.

        Adam by rows does not depend on the place of a row in memory. Without rows, it rounds the
        last values of a column as torch does.
        """
        cfg, table = self.training.cfg, self.scene.table
        chosen, self.decoded = self.decoded, None
        if chosen is not None:
            return chosen.nonzero().squeeze(1)
        return torch.arange(len(table), device=table.device) if cfg.optimizer.by_row else None

    def tensors(self) -> dict[str, Tensor]:
        """Return the state as `Training.tensors` of one process has it: whole in process 0, on the
        CPU. Every process must call this."""
        table, out = self.table, {}
        prefixes = ("params.", "facts.", "stats.", "average.params.", *(f"{self.training.cfg.optimizer.prefix}.{n}." for n in table.params))
        for name, value in self.training.tensors().items():
            if name != f"facts.{NUMBER}":
                of_rows = name.startswith(prefixes) and value.dim() > 0
                out[name] = table.collect(value) if of_rows else value
        return out

    def _networks(self) -> list[Tensor]:
        groups = [group for group in self.training.optimizer.param_groups if group["name"] not in self.scene.table.params]
        return [p for group in groups for p in group["params"] if p.requires_grad]

    def _add_networks(self) -> None:
        """Add the networks' gradients of this turn to those of the turns before."""
        networks = self._networks()
        flag = torch.full((1,), float(bool(self.stop)), dtype=networks[0].dtype, device=networks[0].device)
        flat = torch.cat([*((torch.zeros_like(p) if p.grad is None else p.grad).reshape(-1) for p in networks), flag])
        for parameter in networks:
            parameter.grad = None
        for part in self.group.gather(flat) if self.ordered else [flat]:
            self.total = part.clone() if self.total is None else self.total.add_(part)


def check_shard(cfg: Train, max_memory: float, viewer: bool) -> None:
    """Raise InputError, which names --shard, if a setting needs all rows in one process."""
    why = cfg.scene.needs_whole_table() or cfg.growth.needs_whole_table()
    asked = {
        "--rate": cfg.rate,
        "--exposure": cfg.exposure,
        "--refine-poses": cfg.refine_poses,
        "--max-memory": max_memory > 0,
        "--viewer": viewer,
    }
    why = why or next((flag for flag, given in asked.items() if given), "")
    if why:
        raise InputError(f"expected settings that --shard can divide among the processes, found {why}; leave one of the two out")
