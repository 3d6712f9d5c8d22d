"""The measurements of benchmarks/scale.py at one size: one function per axis, each run in its own process.

A row is (part, seconds, peak): the minimum processor time of one thread over a few runs, and the peak resident memory during them, in
bytes above the level after imports and a tiny training step; it includes everything alive at that time. Either may be None.
"""

from __future__ import annotations

import json
import shutil
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from PIL import Image

from scene_experts.bench import cloud, raster, step
from scene_experts.bench.measure import choose_clock, measure_minima
from scene_experts.core import checkpoint
from scene_experts.core.types import Gaussians
from scene_experts.data.capture import load
from scene_experts.data.lens import Lens
from scene_experts.data.readers.colmap_model import ColmapImage, Model, write_model
from scene_experts.data.settings import Data
from scene_experts.data.views import World
from scene_experts.files.anchors import FAMILY, compact
from scene_experts.render import choose
from scene_experts.strategy import observe
from scene_experts.training.config import RunConfig
from scene_experts.training.photometric import photometric
from scene_experts.training.run_folder import OpenRun
from scene_experts.training.state import Training, save

Row = tuple[str, float | None, int | None]
WIDTH, HEIGHT = 800, 544
BUDGET = 1.5  # seconds for the runs of one part, which are at least two


def read_memory(field: str) -> int:
    """VmRSS (current) or VmHWM (peak since the last `reset_peak`) of this process, in bytes."""
    line = next(line for line in Path("/proc/self/status").read_text().splitlines() if line.startswith(field))
    return 1024 * int(line.split()[1])


def reset_peak() -> None:
    """Reset VmHWM to the current memory."""
    Path("/proc/self/clear_refs").write_text("5")


class Rows:
    """Collects rows; memory counts from the level at construction."""

    def __init__(self) -> None:
        step.make_work(step.MIXTURE, 100, 64, 48)(choose_clock(1))  # torch imports more modules in the first step
        self.base = read_memory("VmRSS")
        self.rows: list[Row] = []

    def add(self, what: str, run: Callable[[], object], again: bool = True) -> None:
        """Time `run` (once if `again` is false, because it changes its input) and record the peak."""
        reset_peak()

        def timed(clock: Callable[[], float]) -> tuple[float]:
            began = clock()
            run()
            return (clock() - began,)

        seconds = measure_minima({what: timed}, BUDGET, choose_clock(1), None if again else {what: 1})[what][0]
        self.record(what, seconds)

    def record(self, what: str, seconds: float | None) -> None:
        self.rows.append((what, seconds, read_memory("VmHWM") - self.base))


def measure_anchors(count: int) -> list[Row]:
    """A moe-gs training of `count` anchors, half of them visible: parts of a step, densification, saving, loading, export."""
    rows = Rows()
    made: list[step.Work] = []
    rows.add("start from points", lambda: made.append(step.make_work(step.MIXTURE, count, WIDTH, HEIGHT)), again=False)
    work = made[0]
    reset_peak()
    parts = measure_minima({"step": work}, BUDGET, choose_clock(1))["step"]
    rows.rows += [(name, seconds, None) for name, seconds in zip(step.PARTS, parts, strict=True)]
    rows.record("whole step", sum(parts))
    held = sum(p.numel() * p.element_size() for g in work.training.optimizer.param_groups for p in g["params"])
    rows.rows.append(("values, moments and gradients alone", None, 4 * held))
    set_statistics(work.training)
    growth, scene = work.training.cfg.growth, work.training.scene
    rows.add("adjustment", lambda: growth.update(scene, 1600, work.training.growth_rng), again=False)  # type: ignore[arg-type]
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        rows.add("save", lambda: save(work.training, folder, 1), again=False)
        rows.add("load", lambda: restore(work.training, folder), again=False)
        run = OpenRun(folder, RunConfig(work.training.cfg, Data(folder)), scene, step.AT, 0.0)
        file = folder / "scene.compact"
        rows.add("export compact", lambda: compact.write(file, FAMILY.contents(run, World(), {}), {}), again=False)
    return rows.rows


def set_statistics(training: Training) -> None:
    """Set gradients and opacities with which about 1 % of the anchors grow new ones and 2 % are pruned."""
    table, generator = training.scene.table, torch.Generator().manual_seed(1)
    observe.start(table, training.scene.K)
    draw = torch.rand(table.stats["grad"].shape, generator=generator)
    table.stats["count"].fill_(50.0)
    table.stats["grad"].copy_(torch.where(draw < 0.002, 50 * 5e-4, 50 * 1e-5))
    table.stats["visits"].fill_(90.0)
    table.stats["opacity"].copy_(torch.where(torch.rand(len(table), generator=generator) < 0.02, 0.1, 30.0))


def restore(training: Training, folder: Path) -> Training:
    path = checkpoint.latest(folder)
    assert path is not None
    return Training.restore(training.cfg, *checkpoint.load(path), "cpu")


def measure_gaussians(count: int) -> list[Row]:
    """The rasteriser on `count` Gaussians that cover the same garden."""
    rows = Rows()
    return measure_raster(rows, make_covering_scene(count), loss=False)


def make_covering_scene(count: int) -> raster.Picture:
    """The benchmark scene with every Gaussian split into as many as needed; smaller ones, so that they cover the same area."""
    base = min(count, cloud.POINTS)
    scene = raster.make_picture(base, WIDTH, HEIGHT)
    if count <= base:
        return scene
    g, generator = scene.gaussians, torch.Generator().manual_seed(2)
    rows = torch.arange(count) % base
    scales = g.scales[rows] * (base / count) ** 0.5
    means = g.means[rows] + torch.randn(count, 3, generator=generator) * g.scales[rows]
    split = Gaussians(means, g.quats[rows], scales, g.opacities[rows], g.colors[rows], torch.arange(count))
    return replace(scene, gaussians=split)


def measure_resolution(height: int) -> list[Row]:
    """100,000 Gaussians and the loss on 16:9 images."""
    return measure_raster(Rows(), raster.make_picture(100_000, height * 16 // 9 // 2 * 2, height), loss=True)


def measure_raster(rows: Rows, scene: raster.Picture, loss: bool) -> list[Row]:
    """Forward and backward pass of the rasteriser; with `loss` also L1 + SSIM."""
    rasterize = choose("auto", "cpu")
    reset_peak()
    parts = measure_minima({"draw": lambda clock: raster.time_draw(rasterize, scene, clock)}, BUDGET, choose_clock(1))["draw"]
    for name, seconds in zip(("raster forward", "raster backward"), parts, strict=True):
        rows.record(name, seconds)
    with torch.no_grad():
        rows.add("raster, no gradient", lambda: rasterize(scene.gaussians, scene.camera, torch.zeros(3)))
    if loss:
        target = 1 - scene.upstream

        def gradient() -> None:
            torch.stack(photometric(scene.upstream.clone().requires_grad_(), target, 0.2)).sum().backward()

        rows.add("loss with gradient", gradient)
    return rows.rows


def measure_views(count: int) -> list[Row]:
    """A COLMAP capture of `count` photographs (640x424 JPEG) and a cache of 64 MiB: loading, shuffling views, one epoch of frames."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        write_views(folder, count)
        rows, kept = Rows(), []
        rows.add("load capture", lambda: kept.append(load(Data(folder), cache_bytes=64 << 20)), again=False)
        capture = kept[0]
        rows.add("fingerprint", capture.fingerprint, again=False)
        training = Training(*_small(capture))
        rows.add("view queue, one epoch", lambda: [training.next_view(capture.train) for _ in capture.train], again=False)
        rows.rows = [(what, seconds, None) if what != "load capture" else (what, seconds, peak) for what, seconds, peak in rows.rows]
        reset_peak()
        began = time.process_time()  # includes the prefetching thread
        for _ in capture.train:
            index, following = training.next_view(capture.train)
            capture.images.prefetch(following)
            capture.frame(index)
        rows.record("frames, one epoch", time.process_time() - began)
        assert capture.images.used_bytes <= 64 << 20
        capture.images.close()
    return rows.rows


def _small(capture: object) -> tuple:
    from scene_experts.training.recipes import RECIPES

    cfg = RECIPES[step.MIXTURE][1].scaled()
    return cfg, cfg.scene.start(capture.points, capture.extent)  # type: ignore[attr-defined]


def write_views(folder: Path, count: int) -> None:
    """Write a ring of cameras around 20,000 points, with eight different photographs under `count` names."""
    rng = np.random.default_rng(0)
    (folder / "images").mkdir()
    smooth = rng.integers(0, 255, (8, 27, 40, 3), dtype=np.uint8)
    for i in range(8):
        Image.fromarray(smooth[i]).resize((640, 424), Image.Resampling.BICUBIC).save(folder / "images" / f"view_{i:05d}.jpg", quality=92)
    posed = []
    for i in range(count):
        name = f"view_{i:05d}.jpg"
        if i >= 8:
            shutil.copyfile(folder / "images" / f"view_{i % 8:05d}.jpg", folder / "images" / name)
        half = np.pi * i / count
        posed.append(ColmapImage(i + 1, name, (float(np.cos(half)), 0.0, float(np.sin(half)), 0.0), (0.0, 0.0, 4.0), 1))
    xyz = rng.normal(size=(20_000, 3)) * 0.6
    rgb = rng.integers(0, 255, xyz.shape, dtype=np.uint8)
    cameras = {1: Lens("PINHOLE", 640, 424, (600.0, 600.0, 320.0, 212.0))}
    write_model(folder / "sparse" / "0", Model(cameras, tuple(posed), np.arange(1, len(xyz) + 1), xyz, rgb, np.full(len(xyz), 0.5)))


AXES: dict[str, Callable[[int], list[Row]]] = {
    "anchors": measure_anchors,
    "gaussians": measure_gaussians,
    "resolution": measure_resolution,
    "views": measure_views,
}

if __name__ == "__main__":
    torch.set_num_threads(1)
    print(json.dumps(AXES[sys.argv[1]](int(sys.argv[2]))))
