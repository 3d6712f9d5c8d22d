"""Where a training step on a GPU spends its time, kernel by kernel, for several recipes in one process.

    python benchmarks/profile_cuda.py --data CAPTURE scaffold-gs@3000 moe-gs@3000 moe-gs@12000

RECIPE@ITERATION names the phase: the experts of moe-gs are dense until iteration 10,000. The scene is that of the beginning, and nothing
is densified. `queued` is the time until the host has launched a step, `busy` that of the kernels. On the CPU only the steps are timed.
"""

from __future__ import annotations

import argparse
import gc
import time
import traceback
from pathlib import Path
from typing import Any

import torch
from torch.profiler import ProfilerActivity, profile

from scene_experts.data.capture import Capture, load
from scene_experts.data.settings import Data
from steps import BLOCK, run_blocks

MOST = 16  # kernels that are listed


class Recorder:
    """Times the steps of a block, or profiles them."""

    def __init__(self, device: str) -> None:
        self.gpu = device == "cuda"
        self.profiler: Any = None
        self.done = 0

    def start(self, with_profiler: bool) -> None:
        self.done, self.queued, self.seconds = 0, 0.0, 0.0
        if with_profiler:
            self.profiler = profile(activities=[ProfilerActivity.CPU, *([ProfilerActivity.CUDA] if self.gpu else [])])

    def before(self) -> None:
        if not self.done:
            self._wait()
            if self.profiler:
                self.profiler.start()
            self.first = time.perf_counter()
        self.last = time.perf_counter()

    def after(self) -> None:
        self.queued += time.perf_counter() - self.last
        self.done += 1
        if self.done == BLOCK - 1:
            self._wait()
            self.seconds = time.perf_counter() - self.first
            if self.profiler:
                self.profiler.stop()

    def _wait(self) -> None:
        if self.gpu:
            torch.cuda.synchronize()


def measure(case: str, data: Path, capture: Capture, device: str, rounds: int) -> str:
    """One line of times, and the kernels that take most."""
    recipe, _, begin = case.partition("@")
    recorder, times = Recorder(device), []
    blocks = run_blocks(recipe, data, capture, int(begin or 3000), recorder.before, recorder.after, device)
    for number in range(rounds + 2):
        recorder.start(with_profiler=number == rounds + 1)
        next(blocks)
        times.append((recorder.seconds, recorder.queued))
    seconds, queued = min(times[1:-1])  # the first block compiles, the last one is profiled
    n = BLOCK - 1
    rows = [e for e in recorder.profiler.key_averages() if str(e.device_type).endswith("CUDA") and e.self_device_time_total > 0]
    busy = sum(e.self_device_time_total for e in rows) / n / 1e3
    lines = [f"{case:22}{1e3 * seconds / n:8.2f} ms a step, {1e3 * queued / n:.2f} queued, {busy:.2f} busy"]
    for e in sorted(rows, key=lambda e: -e.self_device_time_total)[:MOST]:
        lines.append(f"{e.self_device_time_total / n / 1e3:12.4f} ms{e.count / n:7.1f} x  {e.key[:90]}")
    return "\n".join(lines)


def main(argv: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("cases", nargs="+", metavar="RECIPE@ITERATION")
    parser.add_argument("--data", type=Path, required=True, help="a capture")
    parser.add_argument("--resolution", default="auto")
    parser.add_argument("--rounds", type=int, default=3, help="blocks of steps of which the fastest counts")
    parser.add_argument("--device", default="cuda", choices=("cuda", "cpu"))
    args = parser.parse_args(argv)
    capture, failed = load(Data(args.data, resolution=args.resolution)), 0
    for case in args.cases:
        try:
            print(measure(case, args.data, capture, args.device, args.rounds), flush=True)
        except Exception as error:  # the other recipes are measured
            traceback.print_exc()
            print(f"{case}: failed: {error}", flush=True)
            failed += 1
        gc.collect()
        if args.device == "cuda":
            torch.cuda.empty_cache()
    capture.images.close()
    return int(failed > 0)


if __name__ == "__main__":
    raise SystemExit(main())
