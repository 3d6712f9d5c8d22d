"""The strategy of every recipe implements the interface that the loop calls."""

from dataclasses import replace

import pytest
import torch

from scene_experts.core.errors import InputError
from scene_experts.core.fields import check_fields
from scene_experts.strategy import Edit
from scene_experts.training.recipes import RECIPES
from support.scenes import METHODS, start_scene


@pytest.mark.parametrize("recipe", METHODS)
def test_nothing_is_due_at_the_first_iteration(recipe):
    scene, strategy = start_scene(recipe), RECIPES[recipe][1].scaled().growth
    before = {k: v.clone() for k, v in scene.table.columns().items()}
    assert strategy.update(scene, 1, torch.Generator()) is None
    strategy.finish(scene, 1, dict.fromkeys(scene.rate_groups(), 0.0), torch.Generator())
    assert all(torch.equal(before[k], v) for k, v in scene.table.columns().items())


@pytest.mark.parametrize("recipe", METHODS)
def test_impossible_numbers_are_refused(recipe):
    strategy = RECIPES[recipe][1].growth
    check_fields(strategy, "growth")
    with pytest.raises(InputError, match="max-anchors"):
        check_fields(replace(strategy, max_anchors=-1), "growth")


@pytest.mark.parametrize("recipe", METHODS)
def test_rows_are_added_while_densification_runs_and_not_after_it(recipe):
    strategy = RECIPES[recipe][1].growth
    adjust = strategy.adjust
    steps = [step for step in range(1, adjust.stop + 2 * adjust.interval) if strategy.adds(step)]
    assert steps == list(range(adjust.start + adjust.interval, adjust.stop, adjust.interval))
    assert not any(replace(strategy, enabled=False).adds(step) for step in steps)


def test_an_edit_says_what_it_did():
    assert Edit(3, 1, 12) == Edit(grown=3, pruned=1, anchors=12, capped=False)
