"""Decode and loss: both forms do the same work."""

from dataclasses import replace

import torch

from scene_experts.bench import machine, parts
from scene_experts.bench.measure import choose_clock
from scene_experts.scene.anchors.experts import Experts
from scene_experts.scene.anchors.scene import Anchors


def test_the_rows_are_a_share_of_the_table():
    scene, rows = parts.make_scene(Anchors(), 60, 0.5)
    assert len(scene.table) == 120 and len(rows) == 60 and len(rows.unique()) == 60


def test_multiply_adds_are_those_of_the_layers():
    scene, _ = parts.make_scene(Anchors(), 4)
    one = sum(p.numel() for p in scene.network_tensors().values() if p.dim() == 3)
    assert parts.count_multiply_adds(scene.config, 2) == 2 * one


def test_both_forms_decode_the_same_values():
    config = Anchors(decoder=Experts(num=3, top_k=2))
    runs = [parts.Decode(config, form, 40) for form in ("composed", "auto")]
    forward, backward = runs[0](choose_clock(2))
    runs[1](choose_clock(2))
    assert forward > 0 and backward > 0
    a, b = (parts.list_outputs(r.scene.decode(r.rows, r.camera, parts.SPARSE)) for r in runs)
    for x, y in zip(a, b, strict=True):
        torch.testing.assert_close(x, y, atol=1e-4, rtol=1e-4)


def test_figures_name_their_peer():
    here = replace(machine.describe(1), multiply_adds=1e9)
    found = [*parts.measure_decode(50, here, 0.0), *parts.measure_loss(32, 24, here, 0.0)]
    assert {f.group for f in found} == {parts.DECODE, parts.LOSS}
    ratios = [f for f in found if getattr(f, "ratio", None) is not None]
    assert ratios and all(f.peer in (parts.ONE_IN_TORCH, "in torch") for f in ratios)
    assert here.level is None or any(f.name.startswith("share") for f in found)
