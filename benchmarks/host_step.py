"""Measure what a training step on CUDA costs the host, without a GPU: milliseconds, launches, copies and waits.

    PYTHONPATH=PARTS/site python benchmarks/host_step.py --data CAPTURE scaffold-gs scene-experts

PARTS/site is the gsplat of tools/gpu_parts.py, and Python has torch for CUDA and Triton. CUDA is pretended (`pretended_cuda`): the host's
work is real, kernels do nothing. The trainings and their peer, plain gsplat (explicit_gsplat.py), take turns in blocks of steps, so that a
busy machine slows all of them down: compare the ratios. CPU time is that of all threads. The host waits for three numbers in a step: how
many anchors are visible, how many Gaussians they have and how many tiles these touch. It gets those that are given here, in the order of
its copies of 4 and of 8 bytes; `sizes read` shows the order, so that a change is seen. No picture or loss is right.
"""

from __future__ import annotations

import argparse
import gc
import os
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from statistics import median
from typing import Any

from pretended_cuda import start

VIEWS = 20  # of the capture: fewer than a block, so that all photographs are on the device after the first


def make_parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("recipes", nargs="+", metavar="RECIPE")
    parser.add_argument("--data", type=Path, required=True, help="a capture")
    parser.add_argument(
        "--begin", type=int, default=3000, help="iteration of the first step, a multiple of 100; experts are sparse from 10,000"
    )
    parser.add_argument("--rounds", type=int, default=4, help="turns of each training")
    parser.add_argument("--count", type=int, default=545_742, help="Gaussians of the peer")
    parser.add_argument(
        "--reads",
        default="4:56000 4:280000 8:1200000 8:0",
        help="BYTES:NUMBER of the copies that the host waits for; the last of a size repeats",
    )
    parser.add_argument("--kernels", action="store_true", help="list the kernels of the first recipe")
    parser.add_argument(
        "--times", type=Path, help='the device\'s time of kernels, lines "PART OF A NAME microseconds": the host then waits'
    )
    parser.add_argument("--launch", type=float, default=0.0, help="microseconds of the driver for a launch or a copy")
    return parser


def parse_reads(text: str) -> tuple[list[int], list[int]]:
    """The answers to copies of 4 and of 8 bytes. Raises SystemExit for other sizes."""
    pairs = [word.partition(":") for word in text.split()]
    if any(size not in ("4", "8") or not number.isdigit() for size, _, number in pairs):
        raise SystemExit(f"expected 4:NUMBER or 8:NUMBER, found {text}; give for example --reads '4:56000 8:1200000'")
    four, eight = ([int(number) for found, _, number in pairs if found == size] for size in ("4", "8"))
    return four, eight


@dataclass
class Meter:
    """The steps of one training."""

    name: str
    device: Any
    answers: tuple[list[int], list[int]]
    cpu: list[float] = field(default_factory=list)
    wall: list[float] = field(default_factory=list)
    busy: list[float] = field(default_factory=list)
    counted: dict[str, int] = field(default_factory=dict)
    sizes: list[int] = field(default_factory=list)

    def begin(self) -> None:
        self.device.answer(*self.answers)
        self.device.take_busy()
        self._before = self.device.counts()
        self._wall, self._cpu = time.perf_counter(), time.process_time()

    def end(self) -> None:
        cpu, wall = time.process_time() - self._cpu, time.perf_counter() - self._wall
        self.cpu.append(1e3 * cpu)
        self.wall.append(1e3 * wall)
        self.busy.append(1e-3 * self.device.take_busy())
        for name, value in self.device.counts().items():
            self.counted[name] = self.counted.get(name, 0) + value - self._before[name]
        self.sizes = self.device.downloads()

    def forget(self) -> None:
        """Forget the steps so far, which compiled kernels and filled caches."""
        self.cpu, self.wall, self.busy, self.counted = [], [], [], {}


def step_peer(args: argparse.Namespace, capture: Any, meter: Meter) -> Iterator[None]:
    import explicit_gsplat
    from steps import BLOCK

    made = explicit_gsplat.Training(capture, args.count, 30_000, Path("nowhere"), "cuda")
    while True:
        made.step = 2 * args.begin
        for _ in range(BLOCK):
            meter.begin()
            made.iterate()
            meter.end()
        yield


def format_table(meters: list[Meter]) -> str:
    """One line for each training; ratios of medians to the last one, the peer."""
    names = ("launches", "triton launches", "uploads", "downloads", "fills", "waits")
    heads = ("launches", "Triton", "uploads", "downloads", "fills", "waits", "sizes read")
    lines = [f"{'a step':20}{'CPU ms':>9}{'least':>8}{'of peer':>9}{'wall ms':>9}{'of peer':>9}" + "".join(f"{head:>11}" for head in heads)]
    peer = meters[-1]
    for m in meters:
        n = len(m.cpu)
        times = f"{median(m.cpu):9.3f}{min(m.cpu):8.3f}{median(m.cpu) / median(peer.cpu):9.2f}"
        times += f"{median(m.wall):9.3f}{median(m.wall) / median(peer.wall):9.2f}"
        sizes = ",".join(str(size) for size in m.sizes)
        lines.append(f"{m.name:20}{times}" + "".join(f"{m.counted[name] / n:11.1f}" for name in names) + f"{sizes:>11}")
    return "\n".join(lines)


def main(argv: list[str] | None = None) -> None:
    args = make_parser().parse_args(argv)
    answers = parse_reads(args.reads)
    start.enter()
    import torch

    import steps
    from pretended_cuda.counts import Device
    from scene_experts.data.capture import load
    from scene_experts.data.settings import Data

    torch.set_num_threads(1)
    device, capture = Device(), load(Data(args.data, max_views=VIEWS))
    device.speeds.launch = device.speeds.copy = args.launch
    device.speeds.event = args.launch / 2
    if args.times:
        device.set_times(args.times)
    meters = [Meter(name, device, answers) for name in (*args.recipes, "plain gsplat")]
    turns = [steps.run_blocks(m.name, args.data, capture, args.begin, m.begin, m.end) for m in meters[:-1]]
    turns.append(step_peer(args, capture, meters[-1]))
    for round in range(args.rounds + 1):
        for place, turn in enumerate(turns):
            device.clear()
            next(turn)
            if args.kernels and place == 0 and round == args.rounds:
                print(f"kernels of {steps.BLOCK} steps of {args.recipes[0]}", flush=True)
                device.report()
        if round == 0:
            gc.collect()
            gc.freeze()
            for m in meters:
                m.forget()
    print(format_table(meters))
    for m in meters if args.times else ():
        waited = m.counted["waited ns"] / len(m.cpu) / 1e6
        print(f"{m.name}: the device works {median(m.busy):.2f} ms of a step, and the host waits {waited:.2f} ms for it")
    sys.stdout.flush()
    os._exit(0)  # torch would free memory that no device holds


if __name__ == "__main__":
    main()
