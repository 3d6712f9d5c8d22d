"""Measure the rasteriser on one thread, forward + backward, against the scalar peer and the
pure-torch reference."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial

import torch
from torch import Tensor

from scene_experts.bench import cloud, peer
from scene_experts.bench.machine import Machine
from scene_experts.bench.measure import Clock, Figure, Missing, Result, Subject, choose_clock, measure_minima
from scene_experts.core.types import Camera, Gaussians
from scene_experts.render import Rasterizer
from scene_experts.render.cpu import CpuRasterizer
from scene_experts.render.reference import ReferenceRasterizer

GROUP = "rasteriser, one thread"
REFERENCE = "pure-torch reference"
# Operations per blended (pixel, Gaussian) pair, colour and depth: multiply-adds, additions,
# multiplications, comparisons and selections.
# Forward: 2 for the exponent, 6 for its exponential, 2 for the limits of alpha, 3 for the
# transmittance, 2 for the weight and its stop,
# 4 for the sums. Backward: the first 10 again, 5 for weight and stop, 3 for the colour, 6 for what
# lies behind and the gradient of the
# weight, 8 for the ten sums over pixels (of sixteen Gaussians at a time).
FORWARD, BACKWARD = 19, 32


@dataclass(frozen=True)
class Picture:
    """Gaussians, a camera, and the upstream gradient [H, W, 3]."""

    gaussians: Gaussians
    camera: Camera
    upstream: Tensor

    def __str__(self) -> str:
        return f"{len(self.gaussians):,} Gaussians, {self.camera.width}x{self.camera.height}"


def make_picture(count: int, width: int, height: int) -> Picture:
    """The benchmark scene with `count` Gaussians at `width` x `height` pixels."""
    gaussians, camera = cloud.make_scene(cloud.make_cloud(), count, width, height)
    return Picture(gaussians, camera, torch.rand((height, width, 3), generator=torch.Generator().manual_seed(0)))


def time_draw(rasterize: Rasterizer, scene: Picture, clock: Clock) -> tuple[float, float]:
    """Seconds forward and seconds backward."""
    g = scene.gaussians
    means, quats, scales, opacities, colors = (t.clone().requires_grad_() for t in (g.means, g.quats, g.scales, g.opacities, g.colors))
    leaves = replace(g, means=means, quats=quats, scales=scales, opacities=opacities, colors=colors)
    start = clock()
    image = rasterize(leaves, scene.camera, torch.zeros(3)).image
    middle = clock()
    image.backward(scene.upstream)
    return middle - start, clock() - middle


def measure(scene: Picture, machine: Machine, seconds: float) -> list[Result]:
    """Measure forward and backward times, their ratios to both peers, cycles per pair, and the
    share of the arithmetic bound."""
    subjects: dict[str, Subject] = {}
    if machine.level is not None:
        subjects[machine.level] = partial(time_draw, CpuRasterizer(level=machine.level, threads=1), scene)
        subjects["deterministic"] = partial(time_draw, CpuRasterizer(level=machine.level, threads=1, deterministic=True), scene)
    scalar = peer.load(machine.level)
    if scalar is not None:
        subjects[peer.NAME] = lambda clock: scalar.draw(scene.gaussians, scene.camera, scene.upstream, clock)[:2]
    subjects[REFERENCE] = partial(time_draw, ReferenceRasterizer(), scene)
    best = measure_minima(subjects, seconds, choose_clock(1), {REFERENCE: 1, peer.NAME: 3})
    if machine.level is None:
        missing = Missing(GROUP, "compiled rasteriser", "the compiled CPU library is not installed")
        return [missing, *_lines(REFERENCE, best[REFERENCE], None)]
    fast = best[machine.level]
    out: list[Result] = [*_lines(machine.level, fast, (REFERENCE, best[REFERENCE]))]
    out.append(_ratio("deterministic", best["deterministic"], machine.level, fast))
    if scalar is None:
        return [*out, Missing(GROUP, f"against the {peer.NAME}", peer.WHY_NOT)]
    out.append(_ratio(machine.level, fast, peer.NAME, best[peer.NAME]))
    return out + _against_arithmetic(sum(fast), scalar.pairs, scene, machine)


def _lines(name: str, parts: tuple[float, ...], against: tuple[str, tuple[float, ...]] | None) -> list[Figure]:
    out = [Figure(GROUP, f"{name}, {part}", 1e3 * s, "ms") for part, s in zip(("forward", "backward"), parts, strict=True)]
    return out if against is None else [*out, _ratio(name, parts, *against)]


def _ratio(name: str, parts: tuple[float, ...], other: str, others: tuple[float, ...]) -> Figure:
    return Figure(GROUP, f"{name}, forward + backward", 1e3 * sum(parts), "ms", other, sum(others) / sum(parts))


def _against_arithmetic(seconds: float, pairs: int, scene: Picture, machine: Machine) -> list[Result]:
    a_pixel = f"{pairs / scene.upstream[..., 0].numel():.1f} pairs per pixel"
    out: list[Result] = []
    if machine.clock_hz is not None:
        out.append(Figure(GROUP, "core cycles per blended pair", seconds * machine.clock_hz / max(pairs, 1), "cycles", note=a_pixel))
    if machine.multiply_adds is None:
        return out
    bound = pairs * (FORWARD + BACKWARD) / machine.multiply_adds
    note = f"{FORWARD + BACKWARD} operations per pair: {1e3 * bound:.2f} ms"
    return [*out, Figure(GROUP, "share of the arithmetic bound", 100 * bound / seconds, "%", note=note)]
