"""Batches of views, in one process and in several. Groups are forked processes on this machine that exchange over gloo."""

import os
import signal
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch

from scene_experts.core.errors import InputError, RunError
from scene_experts.core.group import Alone
from scene_experts.core.schedule import Every
from scene_experts.data.settings import Data
from scene_experts.render import choose
from scene_experts.scene.anchors.quantise import KEEP
from scene_experts.training.average import Average
from scene_experts.training.batch import Reduced, check_batch
from scene_experts.training.config import RunConfig
from scene_experts.training.config import check as check_train
from scene_experts.training.events import Densified, Previewed, Started, Stepped, Stopped
from scene_experts.training.job import Job
from scene_experts.training.loop import for_training, iterate
from scene_experts.training.state import Training
from support.captures import load
from support.groups import run_group
from support.lanes import slow_except
from support.synthetic import make_capture
from support.trainings import assert_same, config, events, last_tensors

FAMILIES = ("moe-gs", "moe-gs-balance", "octree-gs", "3dgs", "3dgs-mcmc", "sags")


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    return make_capture(tmp_path_factory.mktemp("capture"), views=8, size=(48, 32), points=400).folder


def train(group, cfg, folder, out, **run) -> None:
    list(events(cfg, folder, out, group=group, ordered=True, **run))


def of_family(recipe, **changes) -> Any:
    """A recipe with a batch of 4 that grows from iteration 10 on; random numbers in every place that draws some."""
    cfg: Any = config(recipe, batch=4, iterations=120, schedule=120, random_background=True, **changes)
    cfg = replace(cfg, growth=replace(cfg.growth, adjust=replace(cfg.growth.adjust, start=9, stop=100, interval=20)))
    if hasattr(cfg.growth, "start_stat"):
        cfg = replace(cfg, growth=replace(cfg.growth, start_stat=5, grad_threshold=1e-5))
    if recipe.startswith("moe"):
        cfg = replace(cfg, scene=replace(cfg.scene, decoder=replace(cfg.scene.decoder, warmup=30)))
    return cfg


@pytest.mark.parametrize("recipe", slow_except(FAMILIES, "moe-gs"))
def test_bits_do_not_depend_on_the_number_of_processes(recipe, folder, tmp_path):
    cfg = of_family(recipe)
    seen = list(events(cfg, folder, tmp_path / "one", ordered=True, stop_at=60))
    assert any(e.edit.grown for e in seen if isinstance(e, Densified))
    assert run_group(2, lambda group: train(group, cfg, folder, tmp_path / "two", stop_at=60)) == [0, 0]
    assert_same(last_tensors(tmp_path / "one"), last_tensors(tmp_path / "two"))


@pytest.mark.slow
@pytest.mark.parametrize(
    "changes",
    [{"sparse_adam": True}, {"average": Average(span=0.2)}, {"appearance": 4, "dropout": 0.3, "view_jitter": 0.4}, {"error_views": 3}],
    ids=str,
)
def test_bits_do_not_depend_on_the_number_of_processes_with_options(changes, folder, tmp_path):
    cfg = of_family("moe-gs", **{name: value for name, value in changes.items() if hasattr(config(), name)})
    scene = {name: value for name, value in changes.items() if hasattr(cfg.scene, name)}
    growth = {name: value for name, value in changes.items() if hasattr(cfg.growth, name)}
    cfg = replace(cfg, scene=replace(cfg.scene, **scene), growth=replace(cfg.growth, **growth))
    list(events(cfg, folder, tmp_path / "one", ordered=True, stop_at=60))
    assert run_group(4, lambda group: train(group, cfg, folder, tmp_path / "four", stop_at=60)) == [0] * 4
    assert_same(last_tensors(tmp_path / "one"), last_tensors(tmp_path / "four"))


@pytest.mark.slow
def test_a_run_resumes_in_any_number_of_processes(folder, tmp_path):
    cfg = of_family("moe-gs")
    list(events(cfg, folder, tmp_path / "whole", ordered=True, stop_at=64))
    for stop, processes in ((14, 4), (32, 1), (48, 2), (64, 4)):
        assert set(run_group(processes, lambda g: train(g, cfg, folder, tmp_path / "parts", stop_at=stop, resume=stop > 14))) == {0}  # noqa: B023
    assert_same(last_tensors(tmp_path / "whole"), last_tensors(tmp_path / "parts"))


def test_unordered_sums_differ_by_rounding_alone(folder, tmp_path):
    cfg = of_family("scaffold-gs")

    def unordered(group):
        list(events(cfg, folder, tmp_path / "two", group=group, stop_at=12))

    list(events(cfg, folder, tmp_path / "one", stop_at=12))
    assert run_group(2, unordered) == [0, 0]
    one, two = last_tensors(tmp_path / "one"), last_tensors(tmp_path / "two")
    assert one.keys() == two.keys() and one["stats.visits"].max() == 7  # iterations 6 to 12: 5 is `start_stat`
    assert torch.allclose(one["network.opacity.w1"], two["network.opacity.w1"], rtol=1e-2, atol=1e-3)
    for name in ("visits", "count", "grad"):
        assert float(one[f"stats.{name}"].sum()) == pytest.approx(float(two[f"stats.{name}"].sum()), rel=1e-2)


def test_statistics_of_several_processes_outlive_anchors_that_the_rate_drops(folder):
    capture = load(folder)
    cfg = config("scaffold-gs", iterations=1000, schedule=1000, rate=0.02)
    cfg = replace(cfg, growth=replace(cfg.growth, adjust=Every(260, 900, 280), start_stat=240))  # observes across the removal at 250
    job = Job(RunConfig(cfg, Data(folder)))
    training = Training.start(cfg, capture, "cpu")
    training.rate.first, before, rasterize = 230, len(training.scene.table), for_training(choose("auto", "cpu"), False)
    training.step, exchange = 238, Reduced(training, Alone(), [])
    for _ in range(11):
        iterate(training, job, capture, rasterize, exchange)
    with torch.no_grad():
        training.scene.table.params[KEEP][:3] = -1e3  # closed
    for _ in range(40):
        iterate(training, job, capture, rasterize, exchange)
    assert training.step == 289 and len(training.scene.table) < before
    capture.images.close()


def test_a_request_to_stop_one_process_saves_and_stops_all(folder, tmp_path):
    cfg = of_family("scaffold-gs")

    def stopped(group):
        reasons, last = [], None
        for event in events(cfg, folder, tmp_path, group=group, stop=reasons, log_every=4):
            if group.rank == 1 and isinstance(event, Started):
                reasons.append("SIGTERM")
            last = event
        assert last == Stopped(4, "SIGTERM")

    assert run_group(2, stopped) == [0, 0]
    assert [path.name for path in (tmp_path / "checkpoints").iterdir()] == ["ckpt_000004.safetensors"]


def test_a_lost_process_ends_the_others_and_leaves_the_last_checkpoint(folder, tmp_path):
    cfg = of_family("scaffold-gs")

    def lost(group):
        with pytest.raises(RunError, match="--resume"):
            for event in events(cfg, folder, tmp_path, group=group, save_every=8):
                if group.rank == 1 and isinstance(event, Densified):  # at iteration 20
                    os.kill(os.getpid(), signal.SIGKILL)
        os._exit(3)

    assert run_group(2, lost) == [3, -signal.SIGKILL]
    assert [e.step for e in events(cfg, folder, tmp_path, stop_at=20, resume=True) if isinstance(e, Started)] == [16]


def test_iterations_count_views(folder, tmp_path):
    seen = list(events(of_family("scaffold-gs"), folder, tmp_path, stop_at=22, log_every=10, preview_every=9))
    assert [e.step for e in seen if isinstance(e, Stepped)] == [12, 20, 24]
    assert [e.step for e in seen if isinstance(e, Previewed)] == [12, 20, 24]
    assert [e.step for e in seen if isinstance(e, Densified)] == [20]
    assert float(last_tensors(tmp_path)["adam.feature.0.step"]) == 6 - 1  # anchors miss the step of a densification


def test_growth_observes_each_view_at_its_own_iteration(folder, monkeypatch):
    cfg, seen = of_family("scaffold-gs"), []
    monkeypatch.setattr(type(cfg.growth), "observe", lambda self, scene, decoded, render, step: seen.append(step))
    list(events(cfg, folder, stop_at=8))
    assert seen == [1, 2, 3, 4, 5, 6, 7, 8]


@pytest.mark.parametrize(("power", "factor"), [(0.5, 2), (1.0, 4), (0.0, 1)])
def test_a_batch_has_the_mean_gradient_and_the_rates_of_its_size(folder, power, factor):
    cfg = replace(of_family("scaffold-gs"), random_background=False, batch_rates=power)
    capture = load(folder)
    rasterize = choose("auto", "cpu", deterministic=True)
    training = Training.start(cfg.scaled(), capture, "cpu")
    single = Training.start(replace(cfg, batch=1).scaled(), capture, "cpu")
    training.optimizer.step = single.optimizer.step = lambda *_, **__: 0.0  # type: ignore[method-assign]
    training.optimizer.zero_grad = single.optimizer.zero_grad = lambda *_, **__: None  # type: ignore[method-assign]
    run = Job(RunConfig(cfg, Data(folder)))
    iterate(training, run, capture, rasterize)
    for _ in range(4):
        iterate(single, run, capture, rasterize)
    mean, total = (t.scene.table.params["offsets"].grad for t in (training, single))
    assert mean is not None and total is not None and torch.allclose(mean, total / 4, rtol=1e-4, atol=1e-9)
    assert training.rates()["feature"] == pytest.approx(factor * single.rates()["feature"])
    group = training.optimizer.param_groups[0]
    assert group["betas"] == pytest.approx((0.9**4, 0.999**4)) and group["eps"] == pytest.approx(0.5e-15)
    capture.images.close()


def test_a_power_outside_0_to_1_is_refused():
    with pytest.raises(InputError, match="--batch-rates from 0 to 1"):
        check_train(replace(of_family("scaffold-gs"), batch_rates=1.5))


def test_processes_that_do_not_divide_the_batch_are_refused():
    check_batch(8, 4)
    with pytest.raises(InputError, match="--batch 6"):
        check_batch(4, 3)
