"""Sensitivities against the squared derivatives of a picture, one pixel at a time."""

from dataclasses import replace
from types import SimpleNamespace

import pytest
import torch

from scene_experts.core.types import Mode
from scene_experts.files.anchors import sensitivity
from scene_experts.files.anchors.sensitivity import fingerprint, keep, kept, measure, prepare
from scene_experts.render import choose
from scene_experts.training.run_folder import OpenRun
from support.files import run_in_memory
from support.scenes import CAMERA


@pytest.mark.slow
def test_the_estimate_is_the_mean_of_squared_derivatives(monkeypatch):
    run, draws, found = run_in_memory("moe-gs"), choose("auto", "cpu"), {}
    scene, view, background = (
        run.scene,
        replace(CAMERA, K=torch.tensor([[6.0, 0, 3], [0, 6, 2.5], [0, 0, 1]]), width=6, height=5),
        torch.zeros(3),
    )
    with torch.no_grad():
        for name in ("offsets", "feature"):
            scene.table.params[name] += 0.3 * torch.randn(scene.table.params[name].shape, generator=torch.Generator().manual_seed(1))
    monkeypatch.setattr(sensitivity, "from_sensitivity", lambda columns, networks: found.update(columns=columns, networks=networks))
    measure(scene, run.step, [view] * 300, background, draws, lambda *_: None)
    parameter = scene.table.params["feature"]
    assert not any(p.grad is not None for p in scene.table.params.values())
    image = draws(scene(view, run.step, Mode.DRAW, draws.visible).gaussians, view, background).image
    wanted = torch.zeros_like(parameter)
    for value in image.flatten():
        if value.requires_grad:
            wanted += torch.autograd.grad(value, parameter, retain_graph=True)[0].square()
    wanted /= image.numel()
    assert wanted.sum() > 0
    assert float(found["columns"]["feature"].sum()) == pytest.approx(float(wanted.sum()), rel=0.2)


def test_a_precision_is_kept_with_its_scene_only(tmp_path):
    run = replace(run_in_memory("moe-gs"), path=tmp_path)
    assert kept(run) is None
    steps = {"feature": torch.rand(32), "log_scaling": torch.rand(6), "offsets": torch.rand(30)}
    wanted = sensitivity.Precision(steps, torch.arange(len(run.scene.table)) % 3, {"color.experts.w1": torch.rand(4)})
    keep(run, wanted)
    found = kept(run)
    assert torch.equal(found.classes, wanted.classes) and torch.equal(found.steps["offsets"], steps["offsets"])
    before = fingerprint(run.scene)
    with torch.no_grad():
        run.scene.table.params["feature"][0, 0] += 1
    assert kept(run) is None and fingerprint(run.scene) != before
    (tmp_path / sensitivity.FILE).write_bytes(b"torn")
    assert kept(run) is None and isinstance(run, OpenRun)


def test_the_end_of_a_training_keeps_the_precision(tmp_path):
    run, draws = replace(run_in_memory("scaffold-gs"), path=tmp_path), choose("auto", "cpu")
    capture = SimpleNamespace(views=[SimpleNamespace(camera=CAMERA)], train=(0,), background=(0.0, 0.0, 0.0))
    assert "CPU time" in prepare(run, capture, draws, "cpu")
    found, wanted = kept(run), measure(run.scene, run.step, [CAMERA], torch.zeros(3), draws, lambda *_: None)
    assert torch.equal(found.classes, wanted.classes) and torch.equal(found.steps["feature"], wanted.steps["feature"])
    assert prepare(run, SimpleNamespace(train=()), draws, "cpu") == ""
