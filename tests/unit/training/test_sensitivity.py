"""Sensitivities against the squared derivatives of a picture, one pixel at a time."""

from dataclasses import replace

import pytest
import torch

from scene_experts.core.types import Mode
from scene_experts.render import choose
from scene_experts.training.sensitivity import evenly, find_sensitivity
from support.scenes import CAMERA, start_scene


def test_the_estimate_is_the_mean_of_squared_derivatives():
    scene, draws, background = start_scene("scaffold-gs"), choose("auto", "cpu"), torch.zeros(3)
    view = replace(CAMERA, K=torch.tensor([[6.0, 0, 3], [0, 6, 2.5], [0, 0, 1]]), width=3, height=3)
    with torch.no_grad():
        for name in ("offsets", "feature"):
            scene.table.params[name] += 0.3 * torch.randn(scene.table.params[name].shape, generator=torch.Generator().manual_seed(1))
    values = {"offsets": scene.table.params["offsets"], "other": torch.zeros(2)}
    found = find_sensitivity(scene, values, 1, [view] * 60, background, draws)
    assert not found["other"].any() and not values["other"].requires_grad and values["offsets"].grad is None
    image = draws(scene(view, 1, Mode.DRAW, draws.visible).gaussians, view, background).image
    wanted = torch.zeros_like(values["offsets"])
    for value in image.flatten():
        if value.requires_grad:
            wanted += torch.autograd.grad(value, values["offsets"], retain_graph=True)[0].square()
    wanted /= image.numel()
    assert wanted.sum() > 0
    assert float(found["offsets"].sum()) == pytest.approx(float(wanted.sum()), rel=0.3)


def test_evenly_chosen():
    assert evenly(range(10), 4) == [0, 3, 6, 9] and evenly([5, 6], 4) == [5, 6]
