"""Every recipe's scene keeps the interface: it starts from points, decodes, and is built again from its table and plain values."""

from dataclasses import fields, is_dataclass

import pytest
import torch

from scene_experts.core.table import Table
from scene_experts.core.types import Camera, Points
from scene_experts.recipes import RECIPES
from scene_experts.render import choose
from scene_experts.scene import Scene

METHODS = ("scaffold-gs", "moe-gs", "3dgs", "3dgs-mcmc", "octree-gs", "octree-moe-gs", "scaffold-gs-bank", "sags", "moe-gs-balance")
CAMERA = Camera(torch.eye(4), torch.tensor([[40.0, 0, 24], [0, 40, 16], [0, 0, 1]]), 48, 32, 0.2)


def started(recipe: str) -> Scene:
    torch.manual_seed(0)
    points = Points(torch.randn(200, 3, dtype=torch.float64) + torch.tensor([0.0, 0, 4]), torch.full((200, 3), 128, dtype=torch.uint8))
    return RECIPES[recipe][1].scene.start(points, 5.0, [CAMERA])


@pytest.mark.parametrize("recipe", METHODS)
def test_a_scene_is_built_again_from_its_table_and_plain_values(recipe):
    scene, draw = started(recipe), choose("auto", "cpu")
    params = {k: v.detach().clone() for k, v in scene.table.params.items()}
    again = RECIPES[recipe][1].scene.load(Table(params, dict(scene.table.facts)), scene.meta())
    with torch.no_grad():
        for name, tensor in again.network_tensors().items():
            tensor.copy_(scene.network_tensors()[name])
        first, second = (s(CAMERA, 2000, False, draw.visible) for s in (scene, again))
    assert torch.equal(first.gaussians.source, second.gaussians.source)
    assert torch.equal(first.gaussians.colors, second.gaussians.colors)


@pytest.mark.parametrize("recipe", METHODS)
def test_every_learned_tensor_has_a_rate(recipe):
    scene, cfg = started(recipe), RECIPES[recipe][1]
    groups = scene.rate_groups()
    held = {id(p) for group in groups.values() for p in group}
    assert {id(p) for p in scene.table.params.values()} <= held
    assert {id(p) for p in scene.network_tensors().values() if p.requires_grad} <= held
    assert all(cfg.rates.at(name, 10, 1000, 5.0) >= 0 for name in groups)


@pytest.mark.parametrize("recipe", RECIPES)
def test_every_recipe_is_made_of_frozen_parts_that_scale_and_are_possible(recipe):
    cfg = RECIPES[recipe][1]
    cfg.scene.check()
    for part in (cfg.scene, cfg.growth):
        assert is_dataclass(part) and type(part).__dataclass_params__.frozen and fields(part)  # type: ignore[attr-defined]
        assert part.scaled(1.0) == part
