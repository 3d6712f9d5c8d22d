"""Train one scene whose anchors are divided among 1, 2 and 4 processes: what memory does each process need, and do the bits agree?

Usage: python benchmarks/shards.py [--recipe moe-gs] [--processes 1 2 4] [--batch 4] [--steps 100] [--capture CAPTURE]
The processes are forked on this machine and exchange over gloo, one thread each, with --shard and --deterministic. Printed for the process
that needs most:

tables    bytes of its rows at the worst moment: parameters, gradients, Adam's moments, facts and statistics, in a step or an adjustment
view      bytes of the rows of other processes that it holds at once for one view: parameters, gradients and statistics
process   growth of its peak of resident memory (VmHWM) over the level before the training; it holds buffers, pictures and caches too
sent      bytes that it sends per optimiser step

The digests of the last checkpoints must be equal: the exit code is 1 if they are not.
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import os
import socket
import sys
import tempfile
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from scene_experts.core import checkpoint
from scene_experts.core.group import join
from scene_experts.core.table import Table
from scene_experts.data.capture import load
from scene_experts.data.settings import Data
from scene_experts.render import choose
from scene_experts.training import shards
from scene_experts.training.config import RunConfig
from scene_experts.training.events import Densified
from scene_experts.training.job import Job
from scene_experts.training.loop import train
from scene_experts.training.memory import forget_peak, peak_bytes, reuse_freed, used_bytes
from scene_experts.training.options import TrainOptions
from scene_experts.training.recipes import RECIPES


def size_of(tensors: list[Tensor]) -> int:
    return sum(t.numel() * t.element_size() for t in tensors)


def size_of_rows(table: Table, optimizer: torch.optim.Optimizer | None = None) -> int:
    """Bytes of all tensors that have a row for each row of the table."""
    parameters = list(table.params.values())
    gradients = [p.grad for p in parameters if p.grad is not None]
    moments = [t for p in parameters for t in (optimizer.state.get(p, {}).values() if optimizer else ()) if t.dim()]
    return size_of([*parameters, *gradients, *moments, *table.facts.values(), *table.stats.values()])


class Meter:
    """Measures the tables after each view, after each column that an edit replaces, and before each optimiser step."""

    def __init__(self) -> None:
        self.tables = self.view = 0
        self.state: Any = None

    def look(self) -> None:
        if self.state is not None:
            self.tables = max(self.tables, size_of_rows(self.state.scene.table, self.state.optimizer))

    def attach(self, training: Any) -> None:
        """Measure this training from now on."""
        self.state, meter = training, self
        take, move, replaced = shards.Sharded.add, training.optimizer.step, Table._replace

        def add(exchange: Any, decoded: Any, render: Any) -> None:
            here = exchange.view.table
            take(exchange, decoded, render)
            meter.view = max(meter.view, size_of_rows(here))
            meter.look()

        def step(*args: Any, **more: Any) -> Any:
            out = move(*args, **more)
            meter.look()
            return out

        def replace_column(table: Table, name: str, value: Tensor, edit: Any) -> None:
            old = size_of([table.params[name]]) * 3  # the old column and its moments, which the new ones replace
            replaced(table, name, value, edit)
            if table is training.scene.table:
                meter.tables = max(meter.tables, size_of_rows(table, training.optimizer) + old)

        shards.Sharded.add, training.optimizer.step, Table._replace = add, step, replace_column  # type: ignore[method-assign]


def member(rank: int, size: int, port: int, out: Path, args: argparse.Namespace) -> None:
    """Train in one process of `size`. Writes out/RANK.json."""
    os.environ |= {"RANK": str(rank), "LOCAL_RANK": str(rank), "WORLD_SIZE": str(size)}
    os.environ |= {"MASTER_ADDR": "127.0.0.1", "MASTER_PORT": str(port)}
    torch.set_num_threads(1)
    reuse_freed()
    group, cfg = join("cpu"), RECIPES[args.recipe][1]
    growth: Any = replace(cfg.growth, adjust=replace(cfg.growth.adjust, interval=args.interval))
    cfg = replace(cfg, growth=growth, batch=args.batch, iterations=args.steps * args.batch)
    cfg = replace(cfg, scene=replace(cfg.scene, voxel_size=args.voxel_size))  # type: ignore[call-arg]
    capture = load(Data(args.capture, resolution=args.resolution))
    for index in capture.train:
        capture.frame(index)  # decoded once and kept: not what is measured
    forget_peak()
    meter, before = Meter(), used_bytes(torch.device("cpu"))
    config = RunConfig(cfg, Data(args.capture), deterministic=True)
    run = Job(config, out=out, group=group, shard=True, options=TrainOptions(save_every=10**9, preview_every=0, log_every=10**9))
    rows, edits, peak = 0, 0, 0

    def watch(training: Any) -> None:  # after each step; the save at the end comes later
        nonlocal rows, peak
        if meter.state is None:
            meter.attach(training)
        rows, peak = training.scene.table.total, peak_bytes(torch.device("cpu"))

    for event in train(cfg, replace(run, watch=watch), capture, choose("auto", "cpu", deterministic=True)):
        edits += isinstance(event, Densified)
    capture.images.close()
    facts = {"tables": meter.tables, "view": meter.view, "process": peak - before, "sent": group.sent / args.steps}
    (out / f"{rank}.json").write_text(json.dumps({**facts, "rows": rows, "edits": edits}))
    group.leave()


def trained(size: int, out: Path, args: argparse.Namespace) -> dict[str, Any]:
    """Train in `size` forked processes. Returns the largest value of each fact, and the digest of the last checkpoint."""
    out.mkdir(parents=True)
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    context = multiprocessing.get_context("fork")
    members = [context.Process(target=member, args=(rank, size, port, out, args)) for rank in range(size)]
    for process in members:
        process.start()
    for process in members:
        process.join()
    if any(process.exitcode for process in members):
        sys.exit(f"{size} processes: exit codes {[process.exitcode for process in members]}")
    found = [json.loads((out / f"{rank}.json").read_text()) for rank in range(size)]
    tensors, _ = checkpoint.load(checkpoint.latest(out / "checkpoints"))  # type: ignore[arg-type]
    return {"digest": checkpoint.digest(tensors)[:12], **{name: max(facts[name] for facts in found) for name in found[0]}}


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--recipe", default="moe-gs")
    parser.add_argument("--processes", nargs="+", type=int, default=[1, 2, 4])
    parser.add_argument("--batch", type=int, default=4)
    parser.add_argument("--steps", type=int, default=100)
    parser.add_argument("--interval", type=int, default=100, help="views between two densification steps")
    parser.add_argument("--capture", type=Path, default=Path("demo/brighton"))
    parser.add_argument("--resolution", default="longest:64")
    parser.add_argument("--voxel-size", type=float, default=0.0)
    args = parser.parse_args()
    found = {}
    print(f"{'processes':>9} {'anchors':>9} {'edits':>5} {'tables MB':>10} {'view MB':>8} {'process MB':>10} {'sent MB':>8}  digest")
    with tempfile.TemporaryDirectory() as folder:
        for size in args.processes:
            f = found[size] = trained(size, Path(folder) / str(size), args)
            mb = [f"{f[name] / 1e6:{width}.2f}" for name, width in (("tables", 10), ("view", 8), ("process", 10), ("sent", 8))]
            print(f"{size:>9} {f['rows']:>9} {f['edits']:>5} {' '.join(mb)}  {f['digest']}", flush=True)
    first = found[args.processes[0]]
    for size in args.processes[1:]:
        print(f"{size} processes: {found[size]['tables'] / first['tables']:.3f} of the tables of {args.processes[0]}")
    return 0 if len({f["digest"] for f in found.values()}) == 1 else 1


if __name__ == "__main__":
    sys.exit(main())
