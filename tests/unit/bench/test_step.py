"""A whole step on a synthetic scene: every step is the same, and every part is timed."""

from dataclasses import replace

import torch

from scene_experts.bench import machine, raster, step
from scene_experts.bench.measure import Missing, choose_clock
from scene_experts.core.types import Mode


def test_half_of_the_anchors_are_visible_and_a_step_restores_the_networks():
    work = step.make_work(step.MIXTURE, 200, 64, 48)
    before = {k: v.detach().clone() for k, v in work.training.scene.network_tensors().items()}
    times = work(choose_clock(2))
    assert len(times) == len(step.PARTS) and min(times) >= 0
    assert all(torch.equal(v, before[k]) for k, v in work.training.scene.network_tensors().items())
    assert work.training.optimizer.state and work.training.scene.table.stats["visits"].sum() == 100
    assert work.count_drawn() > 100


def test_copied_networks_draw_the_same_gaussians():
    mixture, base = (step.make_work(recipe, 300, 64, 48) for recipe in (step.MIXTURE, step.BASELINE))
    step.copy_networks(mixture, base)
    for made in (mixture, base):
        made(choose_clock(2))  # a step restores the scene
    a, b = (w.training.scene(w.camera, step.AT, Mode.DRAW, w.rasterize.visible) for w in (mixture, base))
    assert torch.allclose(a.raw_opacity, b.raw_opacity, atol=1e-5) and abs(mixture.count_drawn() - base.count_drawn()) <= 2
    sure = (b.raw_opacity.abs() > 1e-4).all() and len(a.gaussians) == len(b.gaussians)
    assert not sure or torch.allclose(a.gaussians.colors, b.gaussians.colors, atol=1e-4)


def test_measure():
    here = replace(machine.describe(1), copied=1e9)
    found = {f.name: f for f in step.measure(100, 48, 32, here, 0.0)}
    whole = found["whole step"]
    assert whole.ratio > 0 and step.BASELINE in whole.peer
    assert sum(found[part].value for part in step.PARTS) <= whole.value * 1.001


def test_measure_scaling():
    scene = raster.make_picture(200, 48, 32)
    assert isinstance(step.measure_scaling(scene, machine.describe(1), 0.0)[0], Missing)
    threads = torch.get_num_threads()
    found = step.measure_scaling(scene, machine.describe(2), 0.0)
    assert all(isinstance(f, Missing) or f.value > 0 for f in found) and torch.get_num_threads() == threads
