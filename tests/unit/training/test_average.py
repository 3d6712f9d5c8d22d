"""The average of the weights: its formula, its rows through growth, its way through checkpoints."""

from dataclasses import replace

import pytest
import torch

from scene_experts.core.errors import InputError
from scene_experts.core.fields import check_fields
from scene_experts.scene import restore_scene
from scene_experts.training.average import Average, Averages
from scene_experts.training.recipes import RECIPES
from scene_experts.training.state import Training
from support.captures import load
from support.messages import naming
from support.synthetic import make_capture


@pytest.fixture(scope="module")
def capture(tmp_path_factory):
    capture = load(make_capture(tmp_path_factory.mktemp("capture"), views=8).folder)
    yield capture
    capture.images.close()


def started(capture, recipe="moe-gs", span=0.5) -> Training:
    cfg = replace(RECIPES[recipe][1], iterations=100, average=Average(span=span, interval=2))
    return Training.start(cfg.scaled(), capture, "cpu")


def move(training: Training, steps: int) -> None:
    """Add 1 to every weight `steps` times, and update the averages."""
    for _ in range(steps):
        training.step += 1
        for group in training.optimizer.param_groups:
            for parameter in group["params"]:
                parameter.data.add_(1.0)
        training.update_averages()


@pytest.mark.parametrize("recipe", ["moe-gs", "3dgs", "sags"])
def test_the_mean_of_all_then_an_exponential_average(recipe, capture):
    training = started(capture, recipe)
    name = next(iter(training.scene.table.params))
    start = training.scene.table.params[name].detach().clone()
    move(training, 100)
    expected = 0.0
    for updates, value in enumerate(range(2, 101, 2), 1):  # the weights are start + value
        expected += max(1 / updates, 2 / (0.5 * 100)) * (value - expected)
    torch.testing.assert_close(training.scene.table.averages[name], start + expected)


def test_before_the_first_interval_ends_the_average_is_the_last_weights(capture):
    cfg = replace(RECIPES["moe-gs"][1], iterations=100, average=Average(span=0.5, interval=30))
    training = Training.start(cfg.scaled(), capture, "cpu")
    name = next(iter(training.scene.table.params))
    for steps, behind in ((1, 0), (28, 0), (1, 0), (29, 29)):  # iterations 1, 29, 30 and 59: then 30 is the only one of the average
        move(training, steps)
        torch.testing.assert_close(training.scene.table.averages[name] + behind, training.scene.table.params[name].detach())


def test_rows_stay_aligned(capture):
    training = started(capture)
    table = training.scene.table
    move(training, 10)
    kept = torch.arange(len(table)) % 2 == 0
    before = {name: value.clone() for name, value in table.averages.items()}
    table.keep(kept)
    assert all(torch.equal(table.averages[name], value[kept]) for name, value in before.items())
    new = {name: value[:3] + (7 if value.is_floating_point() else 0) for name, value in table.columns().items()}
    table.append(new)
    assert all(torch.equal(table.averages[name][-3:], new[name]) for name in before)
    rows = torch.tensor([1, 4])
    table.overwrite(rows, {"feature": torch.full((2, table.params["feature"].shape[1]), 3.0)})
    assert (table.averages["feature"][rows] == 3.0).all()
    table.assign("offsets", torch.zeros_like(table.params["offsets"]))
    assert not table.averages["offsets"].any()


@pytest.mark.parametrize("recipe", ["moe-gs", "moe-gs-balance", "3dgs"])
def test_a_checkpoint_keeps_both_and_is_opened_with_the_average(recipe, capture):
    training = started(capture, recipe)
    move(training, 20)
    tensors, meta = {k: v.clone() for k, v in training.tensors().items()}, training.meta()
    resumed = Training.restore(training.cfg, tensors, meta, "cpu")
    assert all(torch.equal(resumed.tensors()[k], v) for k, v in tensors.items())
    move(resumed, 10)
    move(training, 10)
    assert all(torch.equal(resumed.tensors()[k], v) for k, v in training.tensors().items() if k.startswith("average."))
    name = next(iter(training.scene.table.params))
    opened = restore_scene(training.cfg.scene, tensors, meta, averaged=True)
    torch.testing.assert_close(opened.table.params[name].detach(), tensors[f"average.params.{name}"])
    assert not torch.equal(opened.table.params[name].detach(), tensors[f"params.{name}"])
    raw = restore_scene(training.cfg.scene, tensors, meta)
    torch.testing.assert_close(raw.table.params[name].detach(), tensors[f"params.{name}"])


def test_drawing_with_the_average_leaves_the_weights(capture):
    training = started(capture)
    move(training, 30)
    weights = {name: p.detach().clone() for name, p in training.scene.table.params.items()}
    networks = {name: p.detach().clone() for name, p in training.scene.network_tensors().items()}
    with training.averaged():
        for name, p in training.scene.table.params.items():
            assert not torch.equal(p, weights[name])
    assert all(torch.equal(training.scene.table.params[name], value) for name, value in weights.items())
    assert all(torch.equal(training.scene.network_tensors()[name], value) for name, value in networks.items())


@pytest.mark.parametrize("recipe", ["moe-gs", "3dgs", "sags"])
def test_a_copy_with_the_average_leaves_the_training_alone(recipe, capture):
    training = started(capture, recipe)
    move(training, 30)
    name = next(iter(training.scene.table.params))
    average, random = training.scene.table.averages[name].clone(), torch.get_rng_state()
    copy = training.averaged_scene()
    assert torch.equal(torch.get_rng_state(), random)
    move(training, 10)
    assert torch.equal(copy.table.params[name], average), "the copy stays as it was"
    assert not torch.equal(training.scene.table.averages[name], average)
    with torch.no_grad():
        copy.table.params[name].zero_()
    assert training.scene.table.averages[name].any()


def test_off_by_default(capture):
    training = Training.start(RECIPES["moe-gs"][1].scaled(), capture, "cpu")
    assert training.averages is None and not training.scene.table.averages
    assert not [name for name in training.tensors() if name.startswith("average.")]


def test_averages_move_with_the_scene(capture):
    scene = started(capture).scene
    Averages(scene)
    scene.to(torch.float64)
    assert all(value.dtype == torch.float64 for value in scene.table.averages.values())


@pytest.mark.parametrize(("change", "words"), [({"span": 1.5}, "--average.span"), ({"interval": 0}, "--average.interval")])
def test_invalid_settings(change, words):
    with pytest.raises(InputError, match=naming(words)):
        check_fields(Average(**change), "average")
