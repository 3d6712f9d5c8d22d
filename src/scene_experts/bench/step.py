"""Measure a whole training step on a synthetic scene, part by part, and how it scales with
threads."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from itertools import pairwise

import torch
from torch import Tensor

from scene_experts.bench import raster
from scene_experts.bench.machine import Machine, measure_multiply_adds
from scene_experts.bench.measure import Clock, Figure, Missing, Result, Subject, choose_clock, measure_minima
from scene_experts.core.types import Camera, Mode, Points
from scene_experts.render import Rasterizer, choose
from scene_experts.render.cpu import CpuRasterizer
from scene_experts.training.config import with_numbers
from scene_experts.training.losses import Sample, compute_terms
from scene_experts.training.recipes import RECIPES
from scene_experts.training.state import Training

MIXTURE, BASELINE = "moe-gs", "scaffold-gs"
GROUP, THREADS = "whole step", "threads"
AT = 2000  # the iteration measured: after the warm-up of the experts, with density statistics
PARTS = ("cull + decode", "raster", "loss", "backward", "statistics", "adam")


@dataclass(frozen=True)
class Work:
    """A training in the middle of its schedule, and one view."""

    training: Training
    camera: Camera
    rasterize: Rasterizer
    target: Tensor  # [H, W, 3]

    def __call__(self, clock: Clock) -> tuple[float, ...]:
        """Run one step and return the seconds of PARTS. The scene is restored, so every step is the
        same."""
        training, scene = self.training, self.training.scene
        before = {k: v.detach().clone() for k, v in self._values().items()}
        times = [clock()]
        training.step = AT
        training.set_rates()
        decoded = scene(self.camera, AT, Mode.TRAIN, self.rasterize.visible)
        times.append(clock())
        render = self.rasterize(decoded.gaussians, self.camera, torch.zeros(3))
        times.append(clock())
        loss = torch.stack(list(compute_terms(Sample(decoded, render, self.target, step=AT), training.cfg.loss).values())).sum()
        times.append(clock())
        loss.backward()
        times.append(clock())
        training.cfg.growth.observe(scene, decoded, render, AT)
        times.append(clock())
        training.optimizer.step()
        training.optimizer.zero_grad(set_to_none=True)
        times.append(clock())
        self._put_back(before)
        return tuple(b - a for a, b in pairwise(times))

    def _values(self) -> dict[str, Tensor]:
        """The tensors that the optimiser updates: columns of the anchors, and networks."""
        scene = self.training.scene
        return {f"column {k}": v for k, v in scene.table.params.items()} | scene.network_tensors()

    @torch.no_grad()
    def _put_back(self, before: dict[str, Tensor]) -> None:
        for name, value in self._values().items():
            value.copy_(before[name])

    @torch.no_grad()
    def count_drawn(self) -> int:
        """Number of Gaussians in the view."""
        return len(self.training.scene(self.camera, AT, Mode.DRAW, self.rasterize.visible).gaussians)


def make_work(recipe: str, anchors: int, width: int, height: int, rasterize: Rasterizer | None = None, seen: float = 0.5) -> Work:
    """Create a step on random anchors. The share `seen` of them fills the image of one camera. The
    others lie behind the camera.

    The networks are freshly initialised. The features are random, so that anchors choose different
    experts.
    """
    torch.manual_seed(0)
    cfg = RECIPES[recipe][1]
    depth = 3 + 5 * torch.rand(anchors)
    depth[round(anchors * seen) :] *= -1
    side = (torch.rand(anchors, 2) - 0.5) * torch.tensor([1.0, height / width])
    xyz = torch.cat([side * depth[:, None].abs(), depth[:, None]], 1).double()
    K = torch.tensor([[width * 1.0, 0, width / 2], [0, width * 1.0, height / 2], [0, 0, 1.0]])
    cfg = with_numbers(cfg, [("scene.voxel_size", 1e-4)])
    scene = cfg.scene.start(Points(xyz, torch.zeros(anchors, 3, dtype=torch.uint8)), 5.0)
    scene.table.params["feature"].data.normal_()
    scene.table.params["offsets"].data.normal_(0, 0.5)
    camera = Camera(torch.eye(4), K, width, height, 0.2)
    return Work(Training(cfg, scene), camera, rasterize or choose("auto", "cpu"), torch.rand(height, width, 3))


@torch.no_grad()
def copy_networks(mixture: Work, base: Work) -> None:
    """Copy the anchors of a baseline to a mixture, and its networks to every expert. Both then
    decode the same Gaussians up to rounding."""
    for name, value in mixture.training.scene.table.params.items():
        value.copy_(base.training.scene.table.params[name])
    networks = base.training.scene.network_tensors()
    for name, value in mixture.training.scene.network_tensors().items():
        if name in networks:  # [E, ...] from [1, ...]; only the mixture has routers
            value.copy_(networks[name].expand_as(value))


def measure(anchors: int, width: int, height: int, machine: Machine, seconds: float) -> list[Result]:
    """The parts of a step of the mixture, the whole step compared with the baseline, and Adam
    compared with the memory it must move."""
    mixture, base = (make_work(recipe, anchors, width, height) for recipe in (MIXTURE, BASELINE))
    copy_networks(mixture, base)
    subjects: dict[str, Subject] = {MIXTURE: mixture, BASELINE: base}
    with use_threads(1):
        best = measure_minima(subjects, seconds, choose_clock(1))
    group = f"{GROUP} of {MIXTURE}, one thread"
    note = f"{round(anchors / 2):,} visible of {anchors:,} anchors, {mixture.count_drawn():,} Gaussians, {width}x{height}"
    out: list[Result] = [Figure(group, part, 1e3 * s, "ms") for part, s in zip(PARTS, best[MIXTURE], strict=True)]
    total, plain = sum(best[MIXTURE]), sum(best[BASELINE])
    out.append(Figure(group, "whole step", 1e3 * total, "ms", f"one of {BASELINE}, same anchors and Gaussians", plain / total, note))
    if machine.copied:
        moved = 28 * sum(p.numel() for g in mixture.training.optimizer.param_groups for p in g["params"])
        share = 100 * moved / machine.copied / best[MIXTURE][PARTS.index("adam")]
        out.append(Figure(group, "adam, share of the memory bound", share, "%", note=f"{moved / 1e6:.0f} MB at a copy's rate; caches help"))
    return out


def measure_scaling(scene: raster.Picture, machine: Machine, seconds: float) -> list[Result]:
    """Gain of all threads over one in a pure arithmetic loop, the rasteriser and a whole step. Wall
    time."""
    if machine.threads < 2:
        return [Missing(THREADS, "gain of threads", "there is only one core or thread: run with --threads 2 or more")]
    if machine.level is None:
        return [Missing(THREADS, "gain of threads", "the compiled CPU library is not installed")]
    n, wall = machine.threads, choose_clock(machine.threads)
    step = make_work(MIXTURE, len(scene.gaussians) * 2 // 5, scene.camera.width, scene.camera.height)

    def run_step(threads: int, clock: Clock) -> tuple[float, ...]:
        with use_threads(threads):
            return step(clock)

    subjects: dict[str, Subject] = {}
    for threads in (1, n):
        rasterize = CpuRasterizer(level=machine.level, threads=threads)
        subjects[f"rasteriser {threads}"] = partial(raster.time_draw, rasterize, scene)
        subjects[f"step {threads}"] = partial(run_step, threads)
        subjects[f"arithmetic {threads}"] = partial(_time_arithmetic, machine.level, threads)
    best = {name: sum(parts) for name, parts in measure_minima(subjects, seconds, wall).items()}
    group, out = f"gain of {n} threads over one (wall time)", []
    for name in ("arithmetic", "rasteriser", "step"):
        gain = best[f"{name} 1"] / best[f"{name} {n}"]
        against = gain * best[f"arithmetic {n}"] / best["arithmetic 1"] if name != "arithmetic" else None
        label = {"arithmetic": "pure arithmetic", "step": f"whole step of {MIXTURE}"}.get(name, name)
        out.append(Figure(group, label, gain, "x", "" if against is None else "pure arithmetic", against))
    return out


def _time_arithmetic(level: str, threads: int, clock: Clock) -> tuple[float]:
    """Seconds of 10^9 multiply-adds."""
    rate = measure_multiply_adds(level, threads, 0.0, clock)
    assert rate is not None
    return (1e9 / rate,)


@contextmanager
def use_threads(threads: int) -> Iterator[None]:
    """Set torch's number of threads, which native code follows, and restore it afterwards."""
    before = torch.get_num_threads()
    torch.set_num_threads(threads)
    try:
        yield
    finally:
        torch.set_num_threads(before)
