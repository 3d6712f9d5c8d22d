"""Time the CPU rasteriser, forward + backward, against a scalar C++ peer and the pure-torch reference, on one scene.

    python benchmarks/raster.py [--cloud garden.npz] [--cases 100000,800,544 ...] [--levels avx512 avx2]
    [--reference] [--threads 1] [--scaling]

Times of one thread are processor time; with more threads they are wall time. All are minima of interleaved runs, so that a busy machine
changes them little. "cycles/pair" is the number of core cycles (time x clock; a loop of dependent additions measures the clock) per
composited (pixel, Gaussian) pair, forward + backward; the peer counts the pairs. The peer is benchmarks/peer/raster_peer.cpp, which this
script compiles with -O3 -march=native. `--scaling` measures threads instead: see raster_threads.py.
"""

from __future__ import annotations

import argparse
import ctypes
import subprocess
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import torch
from torch import Tensor

import raster_threads
from raster_scene import make_cloud, make_scene, read_cloud
from scene_experts.core.types import Camera, Gaussians
from scene_experts.native import library as native
from scene_experts.render import cpu
from scene_experts.render.reference import ReferenceRasterizer

PEER = Path(__file__).parent / "peer"
STAGES = ("project", "bin", "blend", "blend backward", "project backward")


def compile_peer(folder: Path) -> ctypes.CDLL:
    """Build the peer's shared library in `folder` and load it."""
    target = folder / "peer.so"
    source = [str(PEER / "raster_peer.cpp"), str(PEER / "clock.cpp")]
    flags = ["-std=c++17", "-O3", "-march=native", "-fno-math-errno", "-shared", "-fPIC", f"-I{PEER.parents[1] / 'csrc'}"]
    subprocess.run(["c++", *flags, "-o", str(target), *source], check=True)
    library = ctypes.CDLL(str(target))
    library.peer_new.restype = ctypes.c_void_p
    library.peer_composited.restype = ctypes.c_int64
    library.peer_clock_hz.restype = ctypes.c_double
    return library


class Fast:
    """The compiled rasteriser at one instruction set."""

    def __init__(self, level: str | None, threads: int, deterministic: bool = False) -> None:
        self.name = f"cpu {level}" + (" deterministic" if deterministic else "") + (f" x{threads}" if threads > 1 else "")
        self.draw = cpu.CpuRasterizer(level=level, threads=threads, deterministic=deterministic)
        self.stages = [float("inf")] * 5
        self.counts = [0] * 3

    def __call__(self, g: Gaussians, camera: Camera, weights: Tensor, clock: Callable[[], float]) -> tuple[float, float, Tensor, Tensor]:
        """Seconds forward, seconds backward, the image, and the gradient of the means."""
        leaves = [t.clone().requires_grad_() for t in (g.means, g.quats, g.scales, g.opacities, g.colors)]
        start = clock()
        render = self.draw(Gaussians(*leaves, g.source), camera, torch.zeros(3))
        middle = clock()
        kept = render.image.grad_fn.state  # type: ignore[union-attr]
        render.image.backward(weights)
        end = clock()
        counts, seconds = (ctypes.c_int64 * 3)(), (ctypes.c_double * 5)()
        kept.library.se_raster_count(ctypes.c_void_p(kept.address), counts, seconds)
        self.counts = list(counts)
        self.stages = [min(a, b) for a, b in zip(self.stages, seconds, strict=True)]
        return middle - start, end - middle, render.image.detach(), leaves[0].grad  # type: ignore[return-value]


class Peer:
    """The scalar peer."""

    name = "scalar C++ peer"

    def __init__(self, library: ctypes.CDLL) -> None:
        self.library, self.state, self.pairs = library, ctypes.c_void_p(library.peer_new()), 0

    def __call__(self, g: Gaussians, camera: Camera, weights: Tensor, clock: Callable[[], float]) -> tuple[float, float, Tensor, Tensor]:
        """As `Fast`."""
        args = cpu.convert_camera(camera)
        inputs = [g.means, g.quats, g.scales, g.opacities, g.colors]
        image, background = torch.empty((camera.height, camera.width, 3)), torch.zeros(3)
        outputs = [torch.empty_like(t) for t in inputs]
        head = [self.state, ctypes.byref(args), ctypes.c_int64(len(g))]
        start = clock()
        self.library.peer_forward(*head, *[native.pointer(t) for t in [*inputs, background, image]])
        middle = clock()
        self.library.peer_backward(*head, *[native.pointer(t) for t in [*inputs[:3], background, weights, *outputs]])
        end = clock()
        self.pairs = self.library.peer_composited(self.state)
        return middle - start, end - middle, image, outputs[0]


def time_reference(g: Gaussians, camera: Camera, weights: Tensor, clock: Callable[[], float]) -> tuple[float, float, Tensor, Tensor]:
    """The tiled pure-torch reference in float32; as `Fast`."""
    leaves = [t.clone().requires_grad_() for t in (g.means, g.quats, g.scales, g.opacities, g.colors)]
    start = clock()
    render = ReferenceRasterizer()(Gaussians(*leaves, g.source), camera, torch.zeros(3))
    middle = clock()
    render.image.backward(weights)
    return middle - start, clock() - middle, render.image.detach(), leaves[0].grad  # type: ignore[return-value]


def measure_case(case: tuple[int, int, int], args: argparse.Namespace, library: ctypes.CDLL) -> None:
    """Measure and print one case: Gaussians, width, height."""
    g, camera = make_scene(read_cloud(args.cloud) if args.cloud else make_cloud(), *case)
    weights = torch.rand((camera.height, camera.width, 3), generator=torch.Generator().manual_seed(0))
    clock = time.thread_time if args.threads == 1 else time.perf_counter
    fast = [Fast(level, args.threads) for level in args.levels] + [Fast(args.levels[0], args.threads, deterministic=True)]
    peer = Peer(library)
    subjects = [(f.name, f, args.repeat) for f in fast] + [(peer.name, peer, 3)]
    if args.reference:
        subjects.append(("pure-torch tiles", time_reference, 1))
    best: dict[str, list[float]] = {name: [float("inf")] * 2 for name, _, _ in subjects}
    results: dict[str, tuple[Tensor, Tensor]] = {}
    hz = 0.0
    for turn in range(args.repeat):
        hz = max(hz, library.peer_clock_hz())
        for name, subject, most in subjects:
            if turn < most:
                *seconds, image, gradient = subject(g, camera, weights, clock)
                best[name] = [min(a, b) for a, b in zip(best[name], seconds, strict=True)]
                results[name] = (image, gradient)
    print_case(case, args, fast, peer, best, results, hz)


def print_case(
    case: tuple[int, int, int],
    args: argparse.Namespace,
    fast: list[Fast],
    peer: Peer,
    best: dict[str, list[float]],
    results: dict[str, tuple[Tensor, Tensor]],
    hz: float,
) -> None:
    """Print the table of one case."""
    first = fast[0]
    visible, tiles, blocks = first.counts
    size = f"{case[0]} Gaussians, {case[1]}x{case[2]}, {args.threads} thread(s), clock {hz / 1e9:.2f} GHz"
    print(f"\n{size}; {peer.pairs / (case[1] * case[2]):.1f} pairs per pixel, {visible} visible,")
    print(f"{tiles} (Gaussian, tile), {blocks} (Gaussian, block): lanes in use {peer.pairs / 16 / max(1, blocks):.2f}")
    heads = ("forward ms", "backward ms", "total ms", "cycles/pair", "ratio", "image diff", "grad diff")
    print(f"{'':28}" + "".join(f"{head:>12}" for head in heads))
    base, (image, gradient) = sum(best[first.name]), results[first.name]
    for name, (forward, backward) in best.items():
        both, other = forward + backward, results[name]
        differ = float((other[0] - image).abs().mean()), float((other[1] - gradient).norm() / gradient.norm())
        cells = [f"{1e3 * t:.2f}" for t in (forward, backward, both)]
        cells += [f"{both * hz * args.threads / peer.pairs:.2f}", f"{both / base:.2f}", *(f"{d:.1e}" for d in differ)]
        print(f"{name:28}" + "".join(f"{cell:>12}" for cell in cells))
    stages = ", ".join(f"{name} {1e3 * s:.2f}" for name, s in zip(STAGES, first.stages, strict=True))
    share = (first.stages[0] + first.stages[1]) / sum(first.stages[:3])
    print(f"{first.name} stages, ms: {stages}; projection + sort + binning {100 * share:.0f} % of forward")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cloud", type=Path, help="npz of a point cloud (default: a synthetic one)")
    parser.add_argument("--cases", nargs="+", default=["100000,800,544", "500000,800,544"], help="Gaussians,width,height")
    parser.add_argument("--levels", nargs="+", default=[name for name in native.list_levels() if native.find(name)])
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--repeat", type=int, default=15)
    parser.add_argument("--reference", action="store_true", help="also time the pure-torch reference (a minute or more)")
    parser.add_argument("--scaling", action="store_true", help="measure the gain of a second thread instead (raster_threads.py)")
    args = parser.parse_args()
    torch.set_num_threads(args.threads)
    cases = [tuple(int(n) for n in case.split(",")) for case in args.cases]
    if args.scaling:
        for count, width, height in cases:
            g, camera = make_scene(read_cloud(args.cloud) if args.cloud else make_cloud(), count, width, height)
            raster_threads.report(g, camera, max(2, args.threads), 4 * args.repeat)
        return
    with tempfile.TemporaryDirectory() as folder:
        library = compile_peer(Path(folder))
        for count, width, height in cases:
            measure_case((count, width, height), args, library)


if __name__ == "__main__":
    main()
