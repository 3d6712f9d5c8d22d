"""Train one scene in 1, 2 and more processes: do the bits agree, what does a step cost each process, and what do they send?

Usage: python benchmarks/several_processes.py [--recipes moe-gs 3dgs] [--processes 1 2 4] [--batch 4] [--steps 600] [--deterministic]
A step is an optimiser step, which sees `batch` views. The processes are forked on this machine and exchange over gloo, one thread each.
CPU time is that of process 0 inside the iterations. With --deterministic the tensors of the last checkpoint (parameters, Adam's moments,
anchors, statistics, random numbers) must be equal for every number of processes: the exit code is 1 if they are not.
"""

from __future__ import annotations

import argparse
import hashlib
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

from scene_experts.core import checkpoint
from scene_experts.core.group import join
from scene_experts.core.types import Points
from scene_experts.data.capture import load
from scene_experts.data.settings import Data
from scene_experts.render import choose
from scene_experts.training.config import RunConfig, Train
from scene_experts.training.events import Densified
from scene_experts.training.job import Job
from scene_experts.training.loop import train
from scene_experts.training.memory import reuse_freed
from scene_experts.training.options import TrainOptions
from scene_experts.training.recipes import RECIPES


def settings(recipe: str, args: argparse.Namespace) -> Train:
    """The recipe with a batch, on a schedule as long as the run."""
    cfg = RECIPES[recipe][1]
    growth: Any = cfg.growth
    growth = replace(growth, adjust=replace(growth.adjust, interval=args.interval))
    return replace(cfg, batch=args.batch, iterations=args.steps * args.batch, growth=growth, max_anchors=args.max_anchors)


def member(rank: int, size: int, port: int, recipe: str, out: Path, args: argparse.Namespace) -> None:
    """Train in one process of `size`. Process 0 writes out/facts.json."""
    os.environ |= {"RANK": str(rank), "LOCAL_RANK": str(rank), "WORLD_SIZE": str(size)}
    os.environ |= {"MASTER_ADDR": "127.0.0.1", "MASTER_PORT": str(port)}
    torch.set_num_threads(1)
    reuse_freed()
    group, cfg = join("cpu"), settings(recipe, args)
    capture = load(Data(args.capture, resolution=args.resolution))
    if args.points and capture.points is not None:
        every = -(-len(capture.points.xyz) // args.points)
        capture = replace(capture, points=Points(capture.points.xyz[::every], capture.points.rgb[::every]))
    for index in capture.train:
        capture.frame(index)  # decoded once and kept: not what is measured
    state = []
    run = Job(
        RunConfig(cfg, Data(args.capture), deterministic=args.deterministic),
        out=out,
        group=group,
        options=TrainOptions(save_every=10**9, preview_every=0, log_every=10**9),
        begin=state.append,
    )
    edits = [e.edit for e in train(cfg, run, capture, choose("auto", "cpu", deterministic=True)) if isinstance(e, Densified)]
    capture.images.close()
    if group.first:
        clock, steps = state[0].clock, args.steps
        facts = {
            "cpu_ms": 1e3 * (clock.cpu_seconds or 0.0) / steps,
            "wall_ms": 1e3 * clock.seconds / steps,
            "sent_mb": group.sent / steps / 1e6,
            "rows": len(state[0].scene.table),
            "mean_rows": sum(e.anchors for e in edits) / max(1, len(edits)),
            "edits": len(edits),
        }
        (out / "facts.json").write_text(json.dumps(facts))
    group.leave()


def trained(recipe: str, size: int, out: Path, args: argparse.Namespace) -> dict[str, object]:
    """Train in `size` forked processes and return what process 0 measured, with the digest of the last checkpoint."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    context = multiprocessing.get_context("fork")
    members = [context.Process(target=member, args=(rank, size, port, recipe, out, args)) for rank in range(size)]
    for process in members:
        process.start()
    for process in members:
        process.join()
    if any(process.exitcode for process in members):
        sys.exit(f"{recipe} with {size} processes: exit codes {[process.exitcode for process in members]}")
    tensors, _ = checkpoint.load(checkpoint.latest(out / "checkpoints"))  # type: ignore[arg-type]
    digest = hashlib.sha256()
    for name, value in sorted(tensors.items()):
        digest.update(name.encode() + value.contiguous().reshape(-1).view(torch.uint8).numpy().tobytes())
    return {"digest": digest.hexdigest()[:12], **json.loads((out / "facts.json").read_text())}


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--recipes", nargs="+", default=["moe-gs", "moe-gs-balance", "octree-gs", "3dgs", "3dgs-mcmc", "sags"])
    parser.add_argument("--processes", nargs="+", type=int, default=[1, 2, 4])
    parser.add_argument("--batch", type=int, default=4)
    parser.add_argument("--steps", type=int, default=600)
    parser.add_argument("--interval", type=int, default=100, help="views between two densification steps")
    parser.add_argument("--points", type=int, default=0, help="start from about this many points; 0: all")
    parser.add_argument("--max-anchors", type=int, default=0)
    parser.add_argument("--capture", type=Path, default=Path("demo/brighton"))
    parser.add_argument("--resolution", default="longest:64")
    parser.add_argument("--deterministic", action="store_true")
    args = parser.parse_args()
    differ = False
    for recipe in args.recipes:
        digests = set()
        for size in args.processes:
            with tempfile.TemporaryDirectory() as folder:
                found = trained(recipe, size, Path(folder), args)
            digests.add(found["digest"])
            rounded = {name: round(value, 2) if isinstance(value, float) else value for name, value in found.items()}
            print(json.dumps({"recipe": recipe, "processes": size, **rounded}), flush=True)
        differ |= args.deterministic and len(digests) > 1
    return int(differ)


if __name__ == "__main__":
    sys.exit(main())
