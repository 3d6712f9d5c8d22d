"""Measure the peak memory of a training above the level after imports and image cache, compared with the memory that it must have.

Usage: python benchmarks/memory.py [--capture demo/buddha] [--recipe moe-gs] [--anchors 400000] [--spread 0.02] [--iterations 60]
The script copies the capture's points with jitter to `anchors` rows, so that a short run has a large table. The run includes
densification (rows are added and removed) and checkpoints. Resident memory is measured after the images are decoded, and its peak since
then (VmHWM). The bytes needed are parameters + gradients + both moments + the buffers of the largest frame (`memory.frame_bytes` with the
actual number of tiles).
"""

from __future__ import annotations

import argparse
import ctypes
import tempfile
from dataclasses import replace
from pathlib import Path

import torch
from torch import Tensor

from scene_experts.core.schedule import Every
from scene_experts.core.types import Camera, Gaussians, Points, Render
from scene_experts.data.capture import Capture, load
from scene_experts.data.settings import Data
from scene_experts.render import choose
from scene_experts.training import memory
from scene_experts.training.config import RunConfig
from scene_experts.training.events import Densified
from scene_experts.training.job import Job
from scene_experts.training.loop import iterate, train
from scene_experts.training.options import TrainOptions
from scene_experts.training.recipes import RECIPES
from scene_experts.training.state import Training


def read_status(name: str) -> int:
    """A line of /proc/self/status, in bytes."""
    line = next(line for line in Path("/proc/self/status").read_text().splitlines() if line.startswith(name))
    return 1024 * int(line.split()[1])


class Watched:
    """A rasteriser that records the largest frame in bytes."""

    def __init__(self, inner) -> None:
        self.inner, self.largest, self.text = inner, 0, ""
        self.name, self.visible = inner.name, inner.visible

    def __call__(self, gaussians: Gaussians, camera: Camera, background: Tensor) -> Render:
        render = self.inner(gaussians, camera, background)
        state = getattr(render.image.grad_fn, "state", None)
        if state is not None:
            counts, seconds = (ctypes.c_int64 * 3)(), (ctypes.c_double * 5)()
            state.library.se_raster_count(ctypes.c_void_p(state.address), counts, seconds)
            pairs, pixels = counts[1] / max(1, len(gaussians)), camera.width * camera.height
            size = memory.frame_bytes(len(gaussians), pixels, pairs)
            if size > self.largest:
                self.largest = size
                self.text = f"{len(gaussians):,} Gaussians, {pairs:.1f} tiles each, {camera.width}x{camera.height}"
        return render


def multiply_points(capture: Capture, anchors: int, spread: float) -> Capture:
    """The capture with `anchors` points sampled from its own, each with jitter of `spread` extents."""
    assert capture.points is not None
    generator = torch.Generator().manual_seed(0)
    at = torch.randint(len(capture.points.xyz), (anchors,), generator=generator)
    xyz = capture.points.xyz[at]
    xyz = xyz + spread * capture.extent * torch.randn(xyz.shape, generator=generator, dtype=xyz.dtype)
    return replace(capture, points=Points(xyz, capture.points.rgb[at]))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--capture", type=Path, default=Path("demo/buddha"))
    parser.add_argument("--recipe", default="moe-gs")
    parser.add_argument("--anchors", type=int, default=400_000)
    parser.add_argument("--spread", type=float, default=0.02, help="jitter in extents; above 1 most rows are outside of every view")
    parser.add_argument("--iterations", type=int, default=60)
    parser.add_argument("--threads", type=int, default=1)
    args = parser.parse_args()
    torch.set_num_threads(args.threads)
    capture = multiply_points(load(Data(args.capture)), args.anchors, args.spread)
    for index in capture.train:
        capture.frame(index)
    rasterize = Watched(choose("auto", "cpu"))
    recipe = RECIPES[args.recipe][1]
    growth = replace(recipe.growth, start_stat=0, adjust=Every(1, 10**6, 25), success_threshold=0.02, grad_threshold=2e-6)
    cfg = replace(
        recipe, scene=replace(recipe.scene, voxel_size=1e-3), growth=growth, iterations=30_000, max_anchors=args.anchors * 11 // 10
    )
    warm_up(cfg, load(Data(args.capture)), rasterize)
    Path("/proc/self/clear_refs").write_text("5")  # reset the peak
    level = read_status("VmRSS")
    print(f"{args.recipe} on {capture.name}, {args.threads} thread(s); level after import and images {level / 1e6:.0f} MB")
    with tempfile.TemporaryDirectory() as folder:
        run = Job(
            RunConfig(cfg, Data(args.capture), stop_at=args.iterations),
            out=Path(folder),
            options=TrainOptions(save_every=args.iterations // 2, preview_every=0),
        )
        rows, peak = 0, level
        for event in train(cfg, run, capture, rasterize):  # type: ignore[arg-type]
            if read_status("VmHWM") > peak:
                peak = read_status("VmHWM")
                print(f"  {(peak - level) / 1e6:8.1f} MB above it at {event}"[:150])
            rows = event.edit.anchors if isinstance(event, Densified) else rows
    print_report(cfg, capture, rows, rasterize, read_status("VmHWM") - level)
    capture.images.close()


def warm_up(cfg, capture: Capture, rasterize: Watched) -> None:
    """Run two iterations on the unchanged capture, which loads libraries, threads and code into memory."""
    training = Training.start(replace(cfg, max_anchors=0), capture, "cpu")
    for _ in range(2):
        iterate(training, Job(RunConfig(cfg, Data(capture.root))), capture, rasterize)  # type: ignore[arg-type]
    capture.images.close()
    rasterize.largest = 0


def print_report(cfg, capture: Capture, rows: int, rasterize: Watched, above: int) -> None:
    """Print the parts and the ratio."""
    scene = Training.start(cfg, capture, "cpu").scene
    columns = sum(p[:1].numel() for p in scene.table.params.values()) * max(rows, len(scene.table))
    networks = sum(p.numel() for p in scene.network_tensors().values())
    state = 4 * 4 * (columns + networks)
    print(f"rows {max(rows, len(scene.table)):,}: parameters + gradients + moments {state / 1e6:.1f} MB")
    print(f"largest frame {rasterize.largest / 1e6:.1f} MB ({rasterize.text})")
    print(f"peak above the level {above / 1e6:.1f} MB = {above / (state + rasterize.largest):.2f} of both (target <= 1.5)")


if __name__ == "__main__":
    main()
