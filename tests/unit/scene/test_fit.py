"""Foreign checkpoints: what does not fit a scene's settings is refused before the scene is built."""

from dataclasses import replace

import pytest
import torch

from scene_experts.core.errors import InputError
from scene_experts.core.reading.budget import Damaged
from scene_experts.core.types import Points
from scene_experts.scene import restore_scene
from scene_experts.scene.fit import check_fit, restore_foreign
from scene_experts.scene.graph.hash_grid import HashGrid
from scene_experts.training.recipes import RECIPES
from support.scenes import start_scene


def stored(recipe):
    config, scene = RECIPES[recipe][1].scene, start_scene(recipe)
    table = scene.table
    tensors = {f"params.{k}": v.detach() for k, v in table.params.items()} | {f"facts.{k}": v for k, v in table.facts.items()}
    tensors |= {f"network.{k}": v.detach() for k, v in scene.network_tensors().items()}
    return config, tensors, {**scene.meta(), "step": 3}


@pytest.mark.parametrize("recipe", ["3dgs", "scaffold-gs", "scaffold-gs-bank", "moe-gs", "octree-gs", "octree-moe-gs", "sags"])
def test_scenes_that_fit(recipe):
    config, tensors, meta = stored(recipe)
    torch.manual_seed(3)
    found = restore_foreign(config, tensors, meta)
    state = torch.get_rng_state()
    torch.manual_seed(3)
    wanted = restore_scene(config, tensors, meta)
    assert torch.equal(state, torch.get_rng_state())
    assert all(torch.equal(value, wanted.network_tensors()[name]) for name, value in found.network_tensors().items())


def test_many_experts_fit():
    config = RECIPES["moe-gs"][1].scene
    config = replace(config, F=1, hidden=1, K=1, decoder=replace(config.decoder, num=800))
    scene = config.start(Points(torch.rand(9, 3, dtype=torch.float64), torch.zeros(9, 3, dtype=torch.uint8)), 5.0)
    tensors = {f"params.{k}": v.detach() for k, v in scene.table.params.items()} | {f"facts.{k}": v for k, v in scene.table.facts.items()}
    tensors |= {f"network.{k}": v.detach() for k, v in scene.network_tensors().items()}
    assert restore_foreign(config, tensors, {**scene.meta(), "step": 3}).traits.experts == 800


def test_columns_that_do_not_fit():
    config, tensors, meta = stored("octree-moe-gs")
    level = tensors["facts.level"]
    for change in (
        {"params.offsets": tensors["params.offsets"][:, :-1]},
        {"params.offsets": tensors["params.offsets"][:-1]},
        {"params.feature": tensors["params.feature"].long()},
        {"params.feature": tensors["params.feature"] * float("nan")},
        {"facts.cell": tensors["facts.cell"].float()},
        {"facts.level": level + 99},
        {"facts.level": level - 1 - int(level.min())},
        {"network.heads.opacity.w1": torch.tensor([float("inf")])},
        {"network.heads.opacity.w1": torch.tensor([1 + 1j])},
        {"network.heads.opacity.w1": torch.tensor([1e300], dtype=torch.float64)},
        {"params.feature": tensors["params.feature"].double() + 1e300},
        {"facts.slots": torch.ones(len(level), 1, dtype=torch.bool)},
        {"facts.slots": torch.ones(len(level), config.K)},
        {"facts.interval": torch.ones(len(level), 3)},
        {"facts.interval": torch.ones(len(level), dtype=torch.int64)},
    ):
        with pytest.raises(Damaged):
            check_fit(config, tensors | change, meta)
    slots = torch.ones(len(level), config.K, dtype=torch.bool)
    check_fit(config, tensors | {"facts.slots": slots, "facts.interval": torch.ones(len(level))}, meta)
    with pytest.raises(Damaged):
        check_fit(config, {k: v for k, v in tensors.items() if k != "facts.xyz"}, meta)


def test_metadata_out_of_range():
    config, tensors, meta = stored("octree-gs")
    for change in ({"extent": 0.0}, {"extent": 1e300}, {"step": -1}, {"step": 1 << 60}, {"voxel": float("nan")}):
        with pytest.raises(Damaged):
            check_fit(config, tensors, meta | change)
    for change in ({"count": 1 << 40}, {"fork": 0}, {"edge": -1.0}, {"origin": [0, 0]}, {"standard": None}, {"first": 99}, {"rule": "x"}):
        with pytest.raises(Damaged):
            check_fit(config, tensors, meta | {"levels": meta["levels"] | change})


def test_settings_of_networks_that_are_not_stored():
    config, tensors, meta = stored("moe-gs")
    for other in (replace(config, decoder=replace(config.decoder, num=1 << 32)), replace(config, hidden=1 << 30)):
        with pytest.raises(Damaged, match="networks"):
            restore_foreign(other, tensors, meta)
    config, tensors, meta = stored("scaffold-gs")
    with pytest.raises(Damaged, match="networks"):
        restore_foreign(replace(config, decoder=replace(config.decoder, depth=1 << 30)), tensors, meta)
    with pytest.raises(InputError):
        restore_foreign(replace(config, hidden=0), tensors, meta)
    config, tensors, meta = stored("sags")
    with pytest.raises(InputError, match="levels"):
        restore_foreign(replace(config, grid=HashGrid(levels=1 << 30, growth=1.0)), tensors, meta)
