"""Density control of 3DGS against its rule, Gaussian by Gaussian."""

import math
from dataclasses import replace

import pytest
import torch

from scene_experts.core.errors import InputError
from scene_experts.core.fields import check_fields
from scene_experts.core.schedule import Every
from scene_experts.core.types import Decoded, Gaussians, Render
from scene_experts.geometry.rotation import covariance
from scene_experts.strategy.split_clone import SplitClone, split_rows
from support.explicit import EXTENT, make_gaussians, moments


def test_small_gaussians_are_cloned_and_large_ones_split():
    scene, rule = make_gaussians(), SplitClone()
    old = {name: value.detach().clone() for name, value in scene.table.params.items()}
    first = moments(scene, "sh_dc").clone()
    count, grad = scene.table.stats["count"], scene.table.stats["grad"]
    clones, splits = [], []
    for i in range(len(count)):
        if count[i] > 0 and grad[i] / count[i] >= 2e-4:
            (clones if old["log_scales"][i].max().exp() <= 0.01 * EXTENT else splits).append(i)
    assert len(clones) > 10 and len(splits) > 10
    grown, capped = rule.grow(scene, torch.Generator().manual_seed(0))
    p, n = scene.table.params, len(old["means"])
    assert grown == len(clones) + len(splits) and not capped and len(scene.table) == n + grown
    kept = [i for i in range(n) if i not in splits]
    for name, value in p.items():
        assert torch.equal(value[: len(kept)], old[name][kept]), name  # the other rows move up unchanged
        assert torch.equal(value[len(kept) : len(kept) + len(clones)], old[name][clones]), name  # exact copies
    halves = slice(len(kept) + len(clones), None)
    for name in ("quats", "raw_opacity", "sh_dc", "sh_rest"):
        assert torch.equal(p[name][halves], old[name][splits + splits]), name
    torch.testing.assert_close(p["log_scales"][halves].detach().exp(), old["log_scales"][splits + splits].exp() / 1.6)
    assert not torch.equal(p["means"][halves][: len(splits)], p["means"][halves][len(splits) :])
    assert torch.equal(moments(scene, "sh_dc")[: len(kept)], first[kept]) and not moments(scene, "sh_dc")[len(kept) :].any()


def test_halves_are_drawn_from_the_gaussian():
    scene = make_gaussians(2)
    rows = torch.zeros(40_000, dtype=torch.int64)
    halves = split_rows(scene.table.params, rows, torch.Generator().manual_seed(0))
    away = (halves["means"] - scene.table.params["means"][0]).detach().double()
    p = scene.table.params
    quats = torch.nn.functional.normalize(p["quats"][:1].detach().double(), dim=1)
    expected = covariance(quats, p["log_scales"][:1].detach().double().exp())[0]
    found = away.T @ away / len(away)
    assert (found - expected).norm() < 0.03 * expected.norm()


def test_faint_gaussians_go_and_huge_ones_after_the_first_reset():
    for step, huge in ((3000, False), (3100, True)):
        scene, rule = make_gaussians(), SplitClone(min_opacity=0.02, max_size=0.03)
        opacity, size = scene.table.params["raw_opacity"].detach().sigmoid(), scene.table.params["log_scales"].detach().amax(1).exp()
        gone = [i for i in range(len(opacity)) if opacity[i] < 0.02 or (huge and size[i] > 0.03 * EXTENT)]
        keep = [i for i in range(len(opacity)) if i not in gone]
        means = scene.table.params["means"].detach().clone()
        assert rule.prune(scene, step) == len(gone) > 10
        assert torch.equal(scene.table.params["means"], means[keep])


def test_opacities_are_pressed_and_their_moments_cleared():
    scene = make_gaussians()
    before = scene.table.params["raw_opacity"].detach().sigmoid()
    others = moments(scene, "means").clone()
    SplitClone().press_opacities(scene)
    after = scene.table.params["raw_opacity"].detach().sigmoid()
    torch.testing.assert_close(after, before.clamp_max(0.01), atol=1e-7, rtol=1e-5)
    assert not moments(scene, "raw_opacity").any() and torch.equal(moments(scene, "means"), others)


def test_when_things_happen():
    """Densification after 500 at multiples of 100 below 15,000. Resets at multiples of 3000 below 15,000. Statistics restart."""
    rule = SplitClone(grad_threshold=math.inf, min_opacity=0.0, max_size=math.inf)
    for step, adjusts, resets in ((500, 0, 0), (600, 1, 0), (650, 0, 0), (3000, 1, 1), (14_900, 1, 0), (15_000, 0, 0)):
        scene = make_gaussians(20)
        edit = rule.update(scene, step, torch.Generator())
        assert (edit is not None) == bool(adjusts), step
        assert (float(scene.table.params["raw_opacity"].detach().sigmoid().max()) <= 0.0101) == bool(resets), step
        assert adjusts == 0 or not scene.table.stats["count"].any()
        assert (scene.table.params["means"].grad is None) == bool(adjusts)
        assert bool(scene.table.stats) == (step < 15_000)
    assert replace(rule, enabled=False).update(make_gaussians(20), 600, torch.Generator()) is None


def test_statistics_count_what_was_drawn():
    scene, rule = make_gaussians(6), SplitClone()
    scene.table.stats = {}
    rows = torch.tensor([4, 0, 2])
    zeros = torch.zeros(3, 3)
    decoded = Decoded(Gaussians(zeros, zeros, zeros, zeros[:, 0], zeros, rows), rows, None, {})
    grad = torch.tensor([[3.0, 4.0], [1.0, 0.0], [0.0, 2.0]])
    render = Render(zeros, zeros, zeros, torch.tensor([5, 0, 1], dtype=torch.int32), grad)
    rule.observe(scene, decoded, render, 1)
    rule.observe(scene, decoded, render, 14_999)
    rule.observe(scene, decoded, render, 15_000)
    assert scene.table.stats["grad"].tolist() == [0, 0, 4, 0, 10, 0] and scene.table.stats["count"].tolist() == [0, 0, 2, 0, 2, 0]


def test_the_cap_lets_the_largest_gradients_through():
    scene = make_gaussians()
    g = scene.table.stats["grad"] / scene.table.stats["count"].clamp_min(1)
    best = g.argsort(descending=True)[:7]
    small = (scene.table.params["log_scales"].amax(1).exp() <= 0.05)[best]
    means = scene.table.params["means"].detach().clone()
    assert SplitClone().grow(scene, torch.Generator(), cap=207) == (7, True)
    assert len(scene.table) == 207
    copies = scene.table.params["means"].detach()[200 - int((~small).sum()) :][: int(small.sum())]
    assert torch.equal(copies, means[best[small].sort().values])
    full = make_gaussians()
    assert SplitClone().grow(full, torch.Generator(), cap=150) == (0, True) and len(full.table) == 200


def test_windows_scale_and_thresholds_stay():
    rule = SplitClone().scaled(0.5)
    assert rule == replace(SplitClone(), adjust=Every(250, 7500, 100), reset=Every(0, 7500, 1500))
    short = SplitClone().scaled(0.1)  # opacities need hundreds of iterations to come back, however short the training
    assert short.reset == Every(0, 1500, 1000) and not any(SplitClone().scaled(0.05).reset.due(step) for step in range(1500))
    assert SplitClone(reset_least=1).scaled(0.1).reset == Every(0, 1500, 300)
    assert SplitClone(reset=Every(0, 15_000, 400)).scaled(1.0).reset.interval == 400  # what was asked for stays
    with pytest.raises(InputError, match="reset-least"):
        check_fields(replace(rule, reset_least=0), "growth")
    with pytest.raises(InputError, match="reset-opacity"):
        check_fields(replace(rule, reset_opacity=1.0), "growth")
    with pytest.raises(InputError, match=r"reset\.interval"):
        check_fields(replace(rule, reset=Every(0, 10, 0)), "growth")
