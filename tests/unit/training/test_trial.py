"""The views on which the memory of a training is measured before it begins."""

from dataclasses import replace
from pathlib import Path

import pytest
import torch

from scene_experts.core.errors import InputError
from scene_experts.training.recipes import RECIPES
from scene_experts.training.state import Training
from scene_experts.training.trial import fit_memory, unchanged
from support.captures import load
from support.synthetic import make_capture
from support.trainings import config, events


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    return make_capture(tmp_path_factory.mktemp("capture"), views=6, size=(32, 24), points=150).folder


def test_views_are_seen_between_two_checks(folder):
    capture, seen = load(folder), []
    training = Training.start(config().scaled(), capture, "cpu")
    fit_memory(training, 1000.0, capture, lambda *view: seen.append(view[:2]))
    assert {number for number, _ in seen} == {0, training.cfg.iterations + 1} and {index for _, index in seen} <= set(capture.train)
    assert training.largest.level > 0 and capture.images.cache_bytes <= 250 * 2**30
    seen.clear()
    with pytest.raises(InputError, match="--max-memory"):
        fit_memory(training, 0.001, capture, lambda *view: seen.append(view))
    assert not seen
    capture.images.close()


def test_generators_and_networks_are_put_back(folder):
    scene = Training.start(config().scaled(), load(folder), "cpu").scene
    before, generator = {k: v.detach().clone() for k, v in scene.network_tensors().items()}, torch.get_rng_state()
    with unchanged(scene):
        torch.rand(3)
        for tensor in scene.network_tensors().values():
            tensor.data.add_(1.0)
    assert all(torch.equal(v, before[k]) for k, v in scene.network_tensors().items()) and torch.equal(torch.get_rng_state(), generator)


@pytest.mark.slow
@pytest.mark.parametrize("recipe", ["moe-gs-balance", "scene-experts", "octree-moe-gs", "sags", "3dgs-mcmc"])
def test_a_limit_that_is_not_reached_changes_no_bit(recipe, folder):
    """The views on which the memory is measured leave no trace."""
    cfg, ends = replace(RECIPES[recipe][1], iterations=60), []
    for limit in (0.0, 1000.0):
        kept: list[Training] = []
        list(events(cfg, folder, stop_at=12, max_memory=limit, begin=kept.append))
        ends.append(kept[0].tensors())
    assert ends[0].keys() == ends[1].keys() and all(torch.equal(ends[0][name], ends[1][name]) for name in ends[0])
