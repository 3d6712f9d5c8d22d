"""The family's object leads to its writers and readers."""

import torch

from scene_experts.data.views import World
from scene_experts.files.gaussians import FAMILY
from scene_experts.files.registry import family_named
from support.files import run_in_memory


def test_contents_become_the_same_scene_again():
    run, world = run_in_memory("3dgs"), World(2.0, (1.0, 0.0, 0.0))
    assert family_named("gaussians") is FAMILY
    scene, step = FAMILY.scene(run, FAMILY.contents(run, world, FAMILY.describe(run, world)), world)
    assert step > 0 and len(scene.positions) == len(run.scene.positions)
    torch.testing.assert_close(scene.positions, run.scene.positions, rtol=1e-6, atol=1e-6)
