"""The family's object leads to its writers and readers, and states the result folder as a format."""

import pytest
import torch

from scene_experts.data.views import World
from scene_experts.files.anchors import FAMILY
from scene_experts.files.registry import family_named, format_named
from support.files import run_in_memory


@pytest.mark.parametrize("recipe", ["moe-gs", "scaffold-gs-bank"])
def test_contents_become_the_same_scene_again(recipe):
    run, world = run_in_memory(recipe), World(2.0, (1.0, 0.0, 0.0))
    assert family_named("anchors") is FAMILY and format_named("anchors").is_folder
    scene, step = FAMILY.scene(run, FAMILY.contents(run, world, FAMILY.describe(run, world)), world)
    assert step == run.step and torch.equal(scene.positions, run.scene.positions)
    wanted = run.scene.network_tensors()
    for name, value in scene.network_tensors().items():
        torch.testing.assert_close(value, wanted[name], rtol=1e-6, atol=1e-6)
