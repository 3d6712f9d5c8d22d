"""Compare the speed of two checkouts: their training step and their rasteriser, part by part.

Usage: python benchmarks/compare_checkouts.py OTHER_PYTHON [--rounds 20] [--anchors 40000] [--gaussians 100000] [--limit 0.03]
OTHER_PYTHON is the interpreter of the other checkout's environment. Each checkout runs in its own persistent worker process on one
thread. The workers take turns, and the order of a pair alternates. Times are minima of thread CPU time over all rounds, so that other
load on the machine changes them little. A ratio above 1 means that this checkout is slower. With --limit the exit status is 1 if the
ratio of a whole workload is above 1 + limit.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

Times = dict[str, float]  # seconds of each part
RECIPES = ("moe-gs", "scaffold-gs")


def make_workloads(anchors: int, gaussians: int, width: int, height: int) -> dict[str, Callable[[], Times]]:
    """The workloads of the checkout that this process imports; every layout of the package so far has these modules."""
    import torch

    from scene_experts.bench import raster, step
    from scene_experts.render.cpu import CpuRasterizer

    torch.set_num_threads(1)
    make_work = getattr(step, "make_work", None) or step.work  # names of later and of earlier versions
    make_picture = getattr(raster, "make_picture", None) or raster.picture  # type: ignore[attr-defined]
    time_draw = getattr(raster, "time_draw", None) or raster.draw  # type: ignore[attr-defined]

    def time_step(work: Callable) -> Callable[[], Times]:
        return lambda: dict(zip(step.PARTS, work(time.thread_time), strict=True))

    def time_raster(draw: CpuRasterizer) -> Callable[[], Times]:
        return lambda: dict(zip(("forward", "backward"), time_draw(draw, scene, time.thread_time), strict=True))

    scene = make_picture(gaussians, width, height)
    found = {f"step of {recipe}": time_step(make_work(recipe, anchors, width, height)) for recipe in RECIPES}
    found["raster"] = time_raster(CpuRasterizer(threads=1))
    found["raster, deterministic"] = time_raster(CpuRasterizer(threads=1, deterministic=True))
    return found


def serve(sizes: list[int]) -> None:
    """The worker: print the names of the workloads, then run each one that standard input names and print its times."""
    workloads = make_workloads(*sizes)
    print(json.dumps(list(workloads)), flush=True)
    for line in sys.stdin:
        print(json.dumps(workloads[line.strip()]()), flush=True)


class Worker:
    """One checkout in its own process."""

    def __init__(self, python: str, sizes: list[int]) -> None:
        command = [python, str(Path(__file__).resolve()), "--worker", *map(str, sizes)]
        self.process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
        self.names: list[str] = self._read()
        self.best: dict[str, Times] = {}

    def _read(self):
        assert self.process.stdout is not None
        line = self.process.stdout.readline()
        if not line:
            raise SystemExit(f"the worker of {self.process.args[0]} stopped; see its error above")  # type: ignore[index]
        return json.loads(line)

    def run(self, name: str) -> None:
        """Run a workload once and keep the minimum of each part."""
        assert self.process.stdin is not None
        print(name, file=self.process.stdin, flush=True)
        times: Times = self._read()
        times["whole"] = sum(times.values())
        best = self.best.setdefault(name, times)
        self.best[name] = {part: min(seconds, best[part]) for part, seconds in times.items()}

    def stop(self) -> None:
        self.process.communicate()


def compare(other: Worker, this: Worker, rounds: int) -> None:
    """Run all workloads of both, interleaved."""
    for turn in range(rounds):
        for name in this.names:
            for worker in (other, this) if turn % 2 == 0 else (this, other):
                worker.run(name)


def report(other: dict[str, Times], this: dict[str, Times]) -> float:
    """Print one line per part; return the largest ratio of a whole workload."""
    print(f"{'':36}{'other ms':>10}{'this ms':>10}{'ratio':>8}")
    for name, parts in this.items():
        for part, seconds in parts.items():
            before = other[name][part]
            print(f"{name + ', ' + part:36}{1e3 * before:10.2f}{1e3 * seconds:10.2f}{seconds / before:8.3f}")
    return max(parts["whole"] / other[name]["whole"] for name, parts in this.items())


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("python", help="interpreter of the other checkout's environment")
    parser.add_argument("--rounds", type=int, default=20)
    parser.add_argument("--anchors", type=int, default=40_000)
    parser.add_argument("--gaussians", type=int, default=100_000)
    parser.add_argument("--size", type=int, nargs=2, default=[800, 544], metavar=("WIDTH", "HEIGHT"))
    parser.add_argument("--limit", type=float, help="fail if a whole workload is slower by more than this share")
    args = parser.parse_args()
    sizes = [args.anchors, args.gaussians, *args.size]
    other, this = Worker(args.python, sizes), Worker(sys.executable, sizes)
    compare(other, this, args.rounds)
    other.stop(), this.stop()
    worst = report(other.best, this.best)
    return int(args.limit is not None and worst > 1 + args.limit)


if __name__ == "__main__":
    if sys.argv[1:2] == ["--worker"]:
        serve([int(n) for n in sys.argv[2:]])
    else:
        sys.exit(main())
