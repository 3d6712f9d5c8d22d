"""The scene of every recipe implements the interface: it starts from points, decodes, and is restored from its table and metadata."""

from dataclasses import fields, is_dataclass

import pytest
import torch

from scene_experts.core.fields import check_fields
from scene_experts.core.table import Table
from scene_experts.core.types import Mode
from scene_experts.render import choose
from scene_experts.scene.anchors.appearance import Codes
from scene_experts.training.recipes import RECIPES
from support.scenes import CAMERA, METHODS, start_scene


@pytest.mark.parametrize("recipe", METHODS)
def test_a_scene_is_built_again_from_its_table_and_plain_values(recipe):
    scene, draw = start_scene(recipe), choose("auto", "cpu")
    params = {k: v.detach().clone() for k, v in scene.table.params.items()}
    again = RECIPES[recipe][1].scene.load(Table(params, dict(scene.table.facts)), scene.meta())
    with torch.no_grad():
        for name, tensor in again.network_tensors().items():
            tensor.copy_(scene.network_tensors()[name])
        first, second = (s(CAMERA, 2000, Mode.DRAW, draw.visible) for s in (scene, again))
    assert torch.equal(first.gaussians.source, second.gaussians.source)
    assert torch.equal(first.gaussians.colors, second.gaussians.colors)


@pytest.mark.parametrize("recipe", METHODS)
def test_every_learned_tensor_has_a_rate(recipe):
    scene, cfg = start_scene(recipe), RECIPES[recipe][1]
    groups = scene.rate_groups()
    held = {id(p) for group in groups.values() for p in group}
    assert {id(p) for p in scene.table.params.values()} <= held
    assert {id(p) for p in scene.network_tensors().values() if p.requires_grad} <= held
    assert all(cfg.rates.at(name, 10, 1000, 5.0) >= 0 for name in groups)


@pytest.mark.parametrize("recipe", RECIPES)
def test_every_recipe_is_made_of_frozen_parts_that_scale_and_are_possible(recipe):
    cfg = RECIPES[recipe][1]
    check_fields(cfg.scene, "scene")
    for part in (cfg.scene, cfg.growth):
        assert is_dataclass(part) and type(part).__dataclass_params__.frozen and fields(part)  # type: ignore[attr-defined]
        assert part.scaled(1.0) == part


TRAITS = {  # family, rows, lattice, experts, has levels, activation, needs a bake
    "scaffold-gs": ("anchors", "anchors", True, 0, False, True, True),
    "moe-gs": ("anchors", "anchors", True, 5, False, True, True),
    "3dgs": ("gaussians", "Gaussians", False, 0, False, False, False),
    "octree-gs": ("anchors", "anchors", True, 0, True, True, True),
    "octree-moe-gs": ("anchors", "anchors", True, 5, True, True, True),
    "sags": ("graph", "points", True, 0, False, True, True),
}


@pytest.mark.parametrize("recipe", TRAITS)
def test_a_scene_says_what_it_is_and_can_do(recipe):
    scene = start_scene(recipe)
    t = scene.traits
    assert (t.family, t.rows, t.voxel > 0, t.experts, t.levels > 0, t.activation, t.needs_bake) == TRAITS[recipe]
    assert scene.positions.shape == (len(scene.table), 3) and not scene.positions.requires_grad
    assert t.sh_degree == (3 if recipe == "3dgs" else None) and t.appearance == 0 and scene.codes is None
    assert sum(scene.rows_by_level()) == (len(scene.table) if t.levels else 0)


def test_stating_traits_changes_nothing():
    scene = start_scene("moe-gs-balance")
    state, before = torch.random.get_rng_state(), [h.router.balance.clone() for h in scene.heads.values()]
    assert scene.traits.experts == 5
    assert torch.equal(torch.random.get_rng_state(), state)
    assert all(torch.equal(h.router.balance, b) for h, b in zip(scene.heads.values(), before))


@pytest.mark.parametrize("recipe", ["octree-gs", "3dgs"])
def test_at_level_draws_no_finer_level_within_its_block(recipe):
    scene, draw = start_scene(recipe), choose("auto", "cpu")
    draws = lambda: len(scene(CAMERA, 2000, Mode.DRAW, draw.visible).rows)  # noqa: E731
    whole = draws()
    with scene.at_level(0):
        coarse = draws()
    with scene.at_level(None):
        assert draws() == whole
    assert draws() == whole and (coarse < whole if recipe == "octree-gs" else coarse == whole)


@pytest.mark.parametrize("recipe", METHODS)
@pytest.mark.parametrize("flag", [True, False])
def test_a_drawing_with_gradients_changes_nothing_and_torchs_own_mode_has_no_effect(recipe, flag):
    scene, draw = start_scene(recipe), choose("auto", "cpu")
    scene.train(flag)
    before = {k: v.detach().clone() for k, v in {**scene.table.columns(), **scene.network_tensors()}.items()}
    random = torch.random.get_rng_state()
    decoded = scene(CAMERA, 2000, Mode.DRAW, draw.visible)
    assert decoded.gaussians.means.requires_grad or decoded.gaussians.colors.requires_grad
    scene.routing(2000)
    assert torch.equal(torch.random.get_rng_state(), random)
    assert all(torch.equal(v, before[k]) for k, v in {**scene.table.columns(), **scene.network_tensors()}.items())


def test_training_moves_the_biases_of_the_router_even_without_gradients():
    scene, draw = start_scene("moe-gs-balance"), choose("auto", "cpu")
    with torch.no_grad():
        scene(CAMERA, 2000, Mode.TRAIN, draw.visible)
    scene.end_batch(1)
    assert all(head.router.balance.any() for head in scene.heads.values())


def tensors_of(value, path="scene", found=None, visited=None) -> dict[str, torch.Tensor]:
    """Every tensor that can be reached from a value's attributes, by path."""
    found, visited = ({} if found is None else found), (set() if visited is None else visited)
    if id(value) in visited:
        return found
    visited.add(id(value))
    if isinstance(value, torch.Tensor):
        found[path] = value
    elif isinstance(value, dict):
        for name, item in value.items():
            tensors_of(item, f"{path}.{name}", found, visited)
    elif isinstance(value, (list, tuple)):
        for i, item in enumerate(value):
            tensors_of(item, f"{path}[{i}]", found, visited)
    elif hasattr(value, "__dict__") and not isinstance(value, type):
        tensors_of(vars(value), path, found, visited)
    return found


@pytest.mark.parametrize("recipe", METHODS)
def test_to_moves_every_tensor_that_a_scene_owns(recipe):
    scene, draw = start_scene(recipe), choose("auto", "cpu")
    scene(CAMERA, 2000, Mode.DRAW, draw.visible)  # makes what a scene keeps between drawings
    scene.table.stats["visits"] = torch.zeros(len(scene.table))
    before = {path: tensor.dtype for path, tensor in tensors_of(scene).items()}
    wide = {path: tensor.dtype for path, tensor in tensors_of(scene.to(dtype=torch.float64)).items()}
    assert all(dtype == (torch.float64 if before[path].is_floating_point else before[path]) for path, dtype in wide.items())
    assert {path for path, tensor in tensors_of(scene.to("meta")).items() if tensor.device.type != "meta"} == set()


def test_to_moves_fitted_appearance_codes():
    codes = Codes(4, [0, 1])
    codes.fitted[7] = torch.zeros(4)
    assert codes.to("meta").fitted[7].device.type == "meta"
