"""Density control that all anchor methods share. The growth rules have their own files."""

from dataclasses import replace

import pytest
import torch

from scene_experts.core.errors import InputError
from scene_experts.core.fields import check_fields
from scene_experts.core.schedule import Every
from scene_experts.strategy import observe
from scene_experts.strategy.control import AnchorControl
from support.scenes import start_scene


class Still(AnchorControl):
    """Grows nothing."""

    def grow(self, scene, generator, step=0, cap=0):
        return 0, False


@pytest.mark.parametrize("recipe", ["scaffold-gs", "octree-gs"])
def test_faint_anchors_that_were_seen_often_go(recipe):
    scene, rule = start_scene(recipe), AnchorControl()
    n = len(scene.table)
    observe.start(scene.table, scene.K)
    stats = scene.table.stats
    stats["visits"][:] = torch.tensor([80.0, 81.0, 81.0]).repeat(n)[:n]
    stats["opacity"][:] = torch.tensor([0.0, 81 * 0.004, 81 * 0.006]).repeat(n)[:n]
    faint = (torch.arange(n) % 3) == 1
    kept = scene.table.facts["xyz"][~faint]
    assert rule.prune(scene) == int(faint.sum())
    assert torch.equal(scene.table.facts["xyz"], kept)
    assert scene.table.stats["visits"].unique().tolist() == [0.0, 80.0]  # the well-seen ones begin anew
    assert float(scene.table.params["log_scaling"].detach()[:, 3:].max()) <= 0.05 + 1e-6


def test_adjustments_are_due_inside_the_window_and_spare_the_anchors_one_step():
    scene, rule = start_scene("scaffold-gs"), Still(adjust=Every(1500, 15_000, 100))
    assert rule.update(scene, 1600, torch.Generator()) is None  # nothing counted yet
    observe.start(scene.table, scene.K)
    for parameter in scene.table.params.values():
        parameter.grad = torch.ones_like(parameter)
    assert rule.update(scene, 1500, torch.Generator()) is None and rule.update(scene, 1601, torch.Generator()) is None
    edit = rule.update(scene, 1600, torch.Generator())
    assert edit is not None and (edit.grown, edit.pruned) == (0, 0)
    assert all(parameter.grad is None for parameter in scene.table.params.values())
    rule.update(scene, 15_000, torch.Generator())
    assert not scene.table.stats


def test_windows_scale_and_gates_stay():
    half = AnchorControl().scaled(0.5)
    assert (half.start_stat, half.adjust) == (250, Every(750, 7500, 100)) and half.gate() == AnchorControl().gate() == 40
    assert replace(half, start_stat=500, adjust=Every(1500, 15_000, 100), mask_at=(20_000, 30_000)) == AnchorControl()
    with pytest.raises(InputError, match=r"--growth\.adjust\.interval"):
        check_fields(AnchorControl(adjust=Every(1, 2, 0)), "growth")
    with pytest.raises(NotImplementedError):
        AnchorControl().grow(None, torch.Generator())  # type: ignore[arg-type]
