"""What a foreign checkpoint has beside its scene is compared with it before compiled code writes there."""

from collections.abc import Callable

import pytest
import torch
from torch import Tensor

from scene_experts.core.reading.budget import Damaged
from scene_experts.strategy import observe
from scene_experts.training.optim import Adam
from scene_experts.training.recipes import RECIPES
from scene_experts.training.restoring import restore_moments, restore_stats
from scene_experts.training.state import Training
from support.captures import load
from support.messages import naming
from support.synthetic import make_capture


@pytest.fixture(scope="module")
def taken(tmp_path_factory):
    """A training after one step, with statistics."""
    capture = load(make_capture(tmp_path_factory.mktemp("capture"), views=4).folder)
    training = Training.start(RECIPES["scaffold-gs"][1].scaled(), capture, "cpu")
    for parameter in (p for group in training.optimizer.param_groups for p in group["params"]):
        parameter.grad = torch.ones_like(parameter)
    training.optimizer.step()
    observe.start(training.scene.table, training.scene.K)
    yield training
    capture.images.close()


EDITS = {
    "moments of one value": ("adam.feature.0.exp_avg", lambda t: torch.zeros(1)),
    "moments of half the digits": ("adam.offsets.0.exp_avg_sq", Tensor.half),
    "moments of twice the digits": ("adam.log_scaling.0.exp_avg", Tensor.double),
    "a moment that is not finite": ("adam.feature.0.exp_avg", lambda t: t / 0),
    "many counts of steps": ("adam.feature.0.step", lambda t: torch.zeros(2)),
    "whole counts of steps": ("adam.feature.0.step", lambda t: torch.tensor(1)),
    "statistics of one value": ("stats.visits", lambda t: torch.zeros(1)),
    "statistics of one row more": ("stats.grad", lambda t: torch.cat([t, t[:1]])),
    "statistics in whole numbers": ("stats.count", Tensor.long),
}


@pytest.mark.parametrize("what", EDITS)
def test_a_state_that_does_not_fit_is_damaged(taken: Training, what: str) -> None:
    name, edit = EDITS[what]
    tensors = dict(taken.tensors())
    tensors[name] = edit(tensors[name])
    with pytest.raises(Damaged, match=naming(name)):
        Training.restore(taken.cfg, tensors, taken.meta(), "cpu")


@pytest.mark.parametrize("missing", ["exp_avg", "exp_avg_sq", "step"])
def test_a_moment_that_is_missing_or_new_is_damaged(taken: Training, missing: str) -> None:
    tensors = dict(taken.tensors())
    value = tensors.pop(f"adam.feature.0.{missing}")
    with pytest.raises(Damaged, match=naming("adam.feature.0", "exp_avg_sq")):
        Training.restore(taken.cfg, tensors, taken.meta(), "cpu")
    with pytest.raises(Damaged, match=naming("another")):
        Training.restore(taken.cfg, {**taken.tensors(), "adam.feature.0.another": value}, taken.meta(), "cpu")


def test_a_parameter_without_a_state_has_none() -> None:
    parameter = torch.nn.Parameter(torch.zeros(3))
    optimizer = Adam().build([{"params": [parameter], "name": "a"}])
    restore_moments(Adam(), optimizer, {"adam.b.0.step": torch.tensor(1.0)})
    assert not optimizer.state


class Momentum(Adam):
    """An optimiser of somebody else, whose names are not known."""

    prefix, moments = "momentum", None


@pytest.mark.parametrize("value, fits", [(torch.zeros(3), True), (torch.tensor(2.0), True), (torch.zeros(2), False)])
def test_the_state_of_another_optimiser_may_have_any_names(value: Tensor, fits: bool) -> None:
    parameter = torch.nn.Parameter(torch.zeros(3))
    optimizer = Momentum().build([{"params": [parameter], "name": "a"}])
    run: Callable[[], None] = lambda: restore_moments(Momentum(), optimizer, {"momentum.a.0.speed": value})  # noqa: E731
    if not fits:
        with pytest.raises(Damaged, match=naming("momentum.a.0.speed", "[2]")):
            run()
        return
    run()
    assert torch.equal(optimizer.state[parameter]["speed"], value)


def test_statistics_of_rows_and_of_slots_are_restored(taken: Training) -> None:
    tensors = {f"stats.{name}": value for name, value in taken.scene.table.stats.items()}
    restore_stats(taken.scene, tensors)
    assert taken.scene.table.stats.keys() == set(observe.STATS)
