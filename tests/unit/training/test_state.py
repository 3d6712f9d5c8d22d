"""The state of a training becomes named tensors and back without loss. A state of another configuration is refused."""

from dataclasses import replace

import pytest
import torch

from scene_experts.core.errors import InputError
from scene_experts.scene import restore_scene
from scene_experts.training.recipes import RECIPES
from scene_experts.training.state import Training, resume, save
from support.captures import load
from support.messages import naming
from support.synthetic import make_capture


@pytest.fixture(scope="module")
def capture(tmp_path_factory):
    capture = load(make_capture(tmp_path_factory.mktemp("capture"), views=8).folder)
    yield capture
    capture.images.close()


def started(capture, recipe="moe-gs") -> Training:
    training = Training.start(RECIPES[recipe][1].scaled(), capture, "cpu")
    for parameter in (p for group in training.optimizer.param_groups for p in group["params"]):
        parameter.grad = torch.ones_like(parameter)
    training.step = 7
    training.set_rates()
    training.optimizer.step()
    training.next_view(capture.train)
    return training


@pytest.mark.parametrize("recipe", ["scaffold-gs", "moe-gs"])
def test_restored_is_what_was_taken(recipe, capture):
    before = started(capture, recipe)
    tensors = {k: v.clone() for k, v in before.tensors().items()}
    after = Training.restore(before.cfg, tensors, before.meta(), "cpu")
    found = after.tensors()
    assert found.keys() == tensors.keys()
    assert all(torch.equal(found[k], tensors[k]) for k in tensors)
    assert (after.step, after.queue, after.scene.meta()) == (7, before.queue, before.scene.meta())


def test_rates_are_those_of_the_step(capture):
    training = started(capture)
    rates = training.rates()
    assert rates["feature"] == pytest.approx(0.0075)
    assert rates["offsets"] == pytest.approx(training.cfg.rates.at("offsets", 7, training.cfg.iterations, capture.extent))
    assert rates.keys() == {group["name"] for group in training.optimizer.param_groups}


def test_each_view_comes_once_an_epoch(capture):
    training = Training.start(RECIPES["moe-gs"][1].scaled(), capture, "cpu")
    seen = [training.next_view(capture.train)[0] for _ in range(2 * len(capture.train))]
    half = len(capture.train)
    assert sorted(seen[:half]) == sorted(seen[half:]) == sorted(capture.train)


def test_another_configuration_is_refused(capture):
    training = started(capture)
    other = replace(training.cfg, seed=5)
    with pytest.raises(InputError, match=naming("seed", 0, 5)):
        Training.restore(other, training.tensors(), training.meta(), "cpu")


def test_networks_of_another_recipe_are_refused(capture):
    training = started(capture)
    with pytest.raises(InputError):
        restore_scene(RECIPES["scaffold-gs"][1].scene, training.tensors(), training.meta())


def test_saved_is_found_again_and_none_is_none(capture, tmp_path):
    training = started(capture)
    assert resume(training.cfg, tmp_path, "cpu") is None
    save(training, tmp_path, keep=2)
    found = resume(training.cfg, tmp_path, "cpu")
    assert found is not None and found.step == 7
    (next(tmp_path.glob("ckpt_*"))).write_bytes(b"torn")
    with pytest.raises(InputError, match=naming(tmp_path)):
        resume(training.cfg, tmp_path, "cpu")


def test_a_checkpoint_without_a_cpu_time_opens_and_it_stays_unknown(capture):
    training = started(capture)
    meta = {k: v for k, v in training.meta().items() if k not in ("cpu_seconds", "load")}
    after = Training.restore(training.cfg, training.tensors(), meta, "cpu")
    with after.clock.running():
        pass
    found = after.meta()
    assert found["cpu_seconds"] is None and found["seconds"] > meta["seconds"] and "start" not in found["load"]


def test_backgrounds_are_random_after_their_iteration(capture):
    cfg = replace(RECIPES["moe-gs"][1], random_background=True, random_background_from=15_000, iterations=3000).scaled()
    training = Training.start(cfg, capture, "cpu")
    assert cfg.random_background_from == 1500
    for step, random in ((1, False), (1500, False), (1501, True), (3000, True)):
        training.step = step
        ((_, color),) = training.next_batch((0, 1))
        assert (color is not None) is random
