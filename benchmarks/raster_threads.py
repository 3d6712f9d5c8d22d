"""Measure how much the rasteriser gains from a second thread, on idle cores and while other processes occupy every core.

    python benchmarks/raster_threads.py [--cloud garden.npz] [--case 100000,800,544] [--threads 2] [--rounds 60]

Idle: wall time of a loop of independent multiply-adds, and of the rasteriser forward + backward, on one thread and on several; minima of
interleaved runs. Both use the same thread pool, so the ratio of the two gains is the share that the rasteriser keeps. Busy: one endless
loop per core runs at the same time; mean wall time of a frame on one thread and on several, interleaved.
"""

from __future__ import annotations

import argparse
import multiprocessing
import os
import time
from collections.abc import Callable
from pathlib import Path

import torch

from raster_scene import make_cloud, make_scene, read_cloud
from scene_experts.core.types import Camera, Gaussians
from scene_experts.native import library as native
from scene_experts.render.cpu import CpuRasterizer

CHUNKS = 4096  # of multiply-adds: as long as a frame, roughly


def make_arithmetic(threads: int) -> Callable[[], None]:
    """A loop of independent multiply-adds."""
    library = native.require()
    return lambda: library.se_benchmark_multiply_adds(CHUNKS, threads)


def make_raster(g: Gaussians, camera: Camera, threads: int) -> Callable[[], None]:
    """One image and its gradients."""
    draw = CpuRasterizer(threads=threads)
    weights = torch.rand((camera.height, camera.width, 3), generator=torch.Generator().manual_seed(0))
    leaves = [t.clone().requires_grad_() for t in (g.means, g.quats, g.scales, g.opacities, g.colors)]

    def run() -> None:
        draw(Gaussians(*leaves, g.source), camera, torch.zeros(3)).image.backward(weights)
        for leaf in leaves:
            leaf.grad = None

    return run


def measure(runs: dict[str, Callable[[], None]], rounds: int) -> dict[str, list[float]]:
    """Wall seconds of each run, interleaved."""
    taken: dict[str, list[float]] = {name: [] for name in runs}
    for turn in range(rounds + 2):
        for name, run in runs.items():
            start = time.perf_counter()
            run()
            if turn >= 2:
                taken[name].append(time.perf_counter() - start)
    return taken


def spin() -> None:
    """Occupy a core until the parent process ends."""
    parent = os.getppid()
    while os.getppid() == parent:
        sum(range(100_000))


def measure_busy(runs: dict[str, Callable[[], None]], rounds: int) -> dict[str, list[float]]:
    """Like `measure`, while one endless loop per core runs."""
    others = [multiprocessing.get_context("spawn").Process(target=spin, daemon=True) for _ in range(os.cpu_count() or 1)]
    for other in others:
        other.start()
    try:
        time.sleep(1.0)
        return measure(runs, rounds)
    finally:
        for other in others:
            other.kill()
            other.join()


def report(g: Gaussians, camera: Camera, threads: int, rounds: int) -> None:
    """Measure and print both."""
    several = f"{threads} threads"
    runs = {
        "loop 1": make_arithmetic(1),
        f"loop {several}": make_arithmetic(threads),
        "raster 1": make_raster(g, camera, 1),
        f"raster {several}": make_raster(g, camera, threads),
    }
    least = {name: min(taken) for name, taken in measure(runs, rounds).items()}
    loop, drawn = least["loop 1"] / least[f"loop {several}"], least["raster 1"] / least[f"raster {several}"]
    print(f"idle, {several}: multiply-adds {loop:.3f}x, rasteriser {drawn:.3f}x one thread: {drawn / loop:.3f} of it")
    both = {name: run for name, run in runs.items() if name.startswith("raster")}
    mean = {name: sum(taken) / len(taken) for name, taken in measure_busy(both, rounds).items()}
    one, more = mean["raster 1"], mean[f"raster {several}"]
    print(f"busy, every core taken: one thread {1e3 * one:.1f} ms, {several} {1e3 * more:.1f} ms: {more / one:.2f} of its time")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cloud", type=Path, help="npz of a point cloud (default: a synthetic one)")
    parser.add_argument("--case", default="100000,800,544", help="Gaussians,width,height")
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--rounds", type=int, default=60)
    args = parser.parse_args()
    torch.set_num_threads(1)
    count, width, height = (int(n) for n in args.case.split(","))
    g, camera = make_scene(read_cloud(args.cloud) if args.cloud else make_cloud(), count, width, height)
    report(g, camera, args.threads, args.rounds)


if __name__ == "__main__":
    main()
