"""A training whose numbers are no longer finite stops, and no such state is saved."""

import time
from contextlib import suppress
from dataclasses import replace

import pytest
import torch

from scene_experts.core import checkpoint
from scene_experts.core.errors import InputError, RunError
from scene_experts.training import guard, state
from scene_experts.training.events import Saved
from scene_experts.training.optim import FusedAdam
from support.captures import load
from support.messages import naming
from support.synthetic import make_capture
from support.trainings import config, events

AT = 12  # the iteration whose gradient is spoiled


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return make_capture(tmp_path_factory.mktemp("capture"), views=9, size=(48, 32), points=300).folder


def spoil(monkeypatch, value=float("nan"), native=True):
    """Put `value` into one number of one gradient at iteration AT. Returns the names of the parameters that were spoiled."""
    step, count, spoiled = FusedAdam.step, [0], []

    def spoiling(self, *args, **kwargs):
        self._native &= native
        count[0] += 1
        if count[0] == AT:
            group = self.param_groups[1]
            group["params"][0].grad.view(-1)[-1] = value
            spoiled.append(group["name"])
        out = step(self, *args, **kwargs)
        self.broken = self.broken if native else None
        return out

    monkeypatch.setattr(FusedAdam, "step", spoiling)
    return spoiled


@pytest.mark.parametrize("recipe", ["moe-gs", "3dgs", "sags", "octree-moe-gs", "3dgs-mcmc"])
@pytest.mark.parametrize("native", [True, False])
def test_one_nan_in_one_gradient_stops_the_training_before_it_is_saved(recipe, native, folder, tmp_path, monkeypatch):
    monkeypatch.setattr(guard, "EVERY", 4)
    spoiled, saved = spoil(monkeypatch, native=native), []
    with pytest.raises(RunError) as found:
        for event in events(config(recipe), folder, tmp_path, stop_at=40, save_every=5, keep_checkpoints=0):
            saved += [event.step] if isinstance(event, Saved) else []
    assert saved == [5, 10] and "iteration 10 " in str(found.value)
    assert spoiled[0] in str(found.value) or not native  # noise can carry it to another parameter before the next scan
    for file in (tmp_path / "checkpoints").iterdir():
        assert guard.are_finite(checkpoint.load(file)[0].values())


@pytest.mark.parametrize("sparse", [False, True])
def test_a_gradient_whose_square_overflows_is_found_too(sparse, folder, tmp_path, monkeypatch):
    spoiled = spoil(monkeypatch, 1e30)
    with pytest.raises(RunError) as found:
        list(events(config(sparse_adam=sparse), folder, tmp_path, stop_at=40))
    assert spoiled[0] in str(found.value) and f"iteration {AT};" in str(found.value) and "nothing was saved" in str(found.value)


@pytest.mark.parametrize("recipe", ["moe-gs", "3dgs"])
@pytest.mark.parametrize("factor", [1e18, 1e30, 1e37])
def test_points_far_away_train_or_stop_but_are_never_saved_broken(recipe, factor, folder, tmp_path):
    capture = load(folder)
    assert capture.points is not None
    far = replace(capture, points=replace(capture.points, xyz=capture.points.xyz * factor))
    with suppress(RunError, InputError):
        list(events(config(recipe), folder, tmp_path, world=far, stop_at=20))
    capture.images.close()
    for file in tmp_path.rglob("ckpt_*"):
        assert guard.are_finite(checkpoint.load(file)[0].values())


def test_every_save_scans_the_whole_state(folder, tmp_path, monkeypatch):
    def tensors(self, whole=state.Training.tensors):
        return {**whole(self), "stats.opacity": torch.tensor([0.0, float("inf")])}

    monkeypatch.setattr(state.Training, "tensors", tensors)
    with pytest.raises(RunError, match=naming("stats.opacity", "iteration 6")):
        list(events(config(), folder, tmp_path, stop_at=20, save_every=6))
    assert not list(tmp_path.rglob("ckpt_*"))


@pytest.mark.parametrize("value", [float("nan"), float("inf"), float("-inf")])
@pytest.mark.parametrize("shape", [(1,), (7, 3), (5000, 33)])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64, torch.bfloat16])
def test_it_finds_one_number_wherever_it_is(value, shape, dtype):
    tensor = torch.full(shape, torch.finfo(dtype).max, dtype=dtype)  # the sum of these overflows, but each is finite
    assert guard.are_finite([tensor, torch.zeros(0), torch.arange(3)])
    for at in {0, tensor.numel() // 2, tensor.numel() - 1}:
        broken = tensor.clone()
        broken.view(-1)[at] = value
        assert not guard.are_finite([tensor, broken])


@pytest.mark.slow
def test_a_scan_takes_less_than_half_a_percent_of_a_training():
    """A state of 64 MB is scanned in well under the time of the checksum that every save computes."""
    tensors = {str(i): torch.randn(1_000_000) for i in range(16)}
    times = {}
    for name, work in {"scan": lambda: guard.check_state(tensors, 1, None), "digest": lambda: checkpoint.digest(tensors)}.items():
        work()
        began = time.process_time()
        work()
        times[name] = time.process_time() - began
    assert times["scan"] < times["digest"]
