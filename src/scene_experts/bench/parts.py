"""Measure decode and loss on one thread, forward + backward, compiled and in plain torch."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import torch
from torch import Tensor

from scene_experts.bench.machine import Machine
from scene_experts.bench.measure import Clock, Figure, Missing, Result, Subject, choose_clock, measure_minima
from scene_experts.core.table import Table
from scene_experts.core.types import Camera, Decoded
from scene_experts.native import library as native
from scene_experts.scene.anchors.experts import Experts
from scene_experts.scene.anchors.mlp import CHANNELS, Plain
from scene_experts.scene.anchors.scene import ATTRIBUTES, Anchors, AnchorScene
from scene_experts.training.photometric import dissimilarity, l1, photometric

DECODE, LOSS = "decode, one thread", "loss, one thread"
SPARSE = 1_000_000  # an iteration after every warm-up
ONE_IN_TORCH = "one network in torch"


def make_scene(config: Anchors, anchors: int, seen: float = 0.5) -> tuple[AnchorScene, Tensor]:
    """Create random anchors with features similar to trained ones, and the `anchors` visible rows,
    which are the share `seen`."""
    torch.manual_seed(0)
    total = round(anchors / seen)
    params = {
        "feature": 0.5 * torch.randn(total, config.F),
        "offsets": 0.3 * torch.randn(total, config.K, 3),
        "log_scaling": 0.3 * torch.randn(total, 6) - 3,
    }
    facts = {"xyz": torch.randn(total, 3), "cell": torch.zeros(total, 3, dtype=torch.int64)}
    return AnchorScene(config, Table(params, facts), 0.01, 5.0), torch.randperm(total)[:anchors].sort().values


def list_outputs(decoded: Decoded) -> list[Tensor]:
    """The outputs of a decode that receive gradients."""
    g = decoded.gaussians
    raw = [] if decoded.raw_opacity is None else [decoded.raw_opacity]
    return [g.means, g.quats, g.scales, g.opacities, g.colors, *raw, *(r.gates for r in decoded.routing.values())]


class Decode:
    """One decoder in one form. Every run takes the same rows, camera and upstream gradients."""

    scene: AnchorScene
    rows: Tensor
    camera: Camera

    def __init__(self, config: Anchors, form: str, anchors: int) -> None:
        self.scene, self.rows = make_scene(replace(config, decode=form), anchors)  # type: ignore[arg-type]
        pose = torch.eye(4)
        pose[2, 3] = 6.0
        self.camera = Camera(pose, torch.eye(3), 800, 544)
        self.upstream: list[Tensor] = []

    def __call__(self, clock: Clock) -> tuple[float, float]:
        self.scene.zero_grad(set_to_none=True)
        began = clock()
        values = list_outputs(self.scene.decode(self.rows, self.camera, SPARSE))
        forward = clock() - began
        self.upstream = self.upstream or [torch.randn_like(v) for v in values]
        began = clock()
        torch.autograd.backward(values, self.upstream)
        return forward, clock() - began


def measure_decode(anchors: int, machine: Machine, seconds: float) -> list[Result]:
    """Measure Top-2 of 5 experts (the paper) and one network, compiled and in torch. Ratios are to
    one network in torch."""
    one, top2 = Anchors(decoder=Plain()), Anchors(decoder=Experts(num=5, top_k=2))
    kinds = {ONE_IN_TORCH: (one, "composed"), "Top-2 of 5 in torch": (top2, "composed")}
    if machine.level is not None:
        kinds |= {f"one network, {machine.level}": (one, "native"), f"Top-2 of 5, {machine.level}": (top2, "native")}
    subjects: dict[str, Subject] = {name: Decode(*kind, anchors) for name, kind in kinds.items()}
    both = {name: sum(parts) for name, parts in measure_minima(subjects, seconds, choose_clock(1)).items()}
    note = f"{anchors:,} anchors"
    out: list[Result] = [Figure(DECODE, ONE_IN_TORCH, 1e3 * both[ONE_IN_TORCH], "ms", note=note)]
    out += [Figure(DECODE, n, 1e3 * s, "ms", ONE_IN_TORCH, both[ONE_IN_TORCH] / s) for n, s in both.items() if n != ONE_IN_TORCH]
    if machine.level is None:
        return [*out, Missing(DECODE, "compiled decode", "the compiled CPU library is not installed")]
    if machine.multiply_adds is not None:
        # The backward pass has two multiplications for each one of the forward pass.
        bound = 3 * anchors * count_multiply_adds(top2, 2) / machine.multiply_adds
        share = 100 * bound / both[f"Top-2 of 5, {machine.level}"]
        out.append(Figure(DECODE, "share of the arithmetic bound", share, "%", note=f"the experts' products alone: {1e3 * bound:.2f} ms"))
    return out


def count_multiply_adds(config: Anchors, experts: int) -> int:
    """Multiply-adds of one anchor's forward pass through `experts` networks per attribute."""
    inputs = config.F + 3
    return experts * sum(config.hidden * (inputs + config.K * CHANNELS[attribute]) for attribute in ATTRIBUTES)


def measure_loss(width: int, height: int, machine: Machine, seconds: float) -> list[Result]:
    """Measure L1 + SSIM with its gradient, in one compiled call and in plain torch."""
    torch.manual_seed(0)
    target = torch.rand(height, width, 3)
    image = (target + 0.05 * torch.randn_like(target)).clamp(0, 1)
    subjects: dict[str, Subject] = {"in torch": partial(_time_gradient, False, image, target)}
    if machine.level is not None:
        subjects[f"fused, {machine.level}"] = partial(_time_gradient, True, image, target)
    best = measure_minima(subjects, seconds, choose_clock(1), {"in torch": 8})
    plain, note = best.pop("in torch")[0], f"L1 + SSIM with its gradient, {width}x{height}"
    out: list[Result] = [Figure(LOSS, "in torch", 1e3 * plain, "ms", note=note)]
    out += [Figure(LOSS, name, 1e3 * s, "ms", "in torch", plain / s) for name, (s,) in best.items()]
    missing = Missing(LOSS, "fused loss", "the compiled CPU library is not installed")
    return out if native.load() is not None else [*out, missing]


def _time_gradient(fused: bool, image: Tensor, target: Tensor, clock: Clock) -> tuple[float]:
    leaf = image.clone().requires_grad_()
    began = clock()
    if fused:
        torch.stack(photometric(leaf, target, 0.2)).sum().backward()
    else:
        (0.8 * l1(leaf, target) + 0.2 * dissimilarity(leaf, target)).backward()
    return (clock() - began,)
