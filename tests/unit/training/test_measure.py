"""The statistics of an iteration."""

import math
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from scene_experts.data.settings import Data
from scene_experts.render import choose
from scene_experts.training.config import RunConfig
from scene_experts.training.events import Stepped
from scene_experts.training.job import Job
from scene_experts.training.loop import iterate
from scene_experts.training.measure import measure_step
from scene_experts.training.state import Training
from support.captures import load
from support.synthetic import make_capture
from support.trainings import config, events


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    return make_capture(tmp_path_factory.mktemp("capture"), views=16).folder


def test_the_psnr_of_a_step_is_that_of_the_pixels_that_count(folder):
    capture = load(folder)
    training = Training.start(config().scaled(), capture, "cpu")
    run = Job(RunConfig(config(), Data(folder)))
    done = iterate(training, run, capture, choose("auto", "cpu"))
    capture.images.close()
    half = torch.zeros_like(done.target[..., 0])
    half[:, : half.shape[1] // 2] = 1
    columns = half[0] > 0
    mse = float((done.render.image.detach().clamp(0, 1) - done.target)[:, columns].square().mean())
    assert measure_step(training, replace(done, mask=half)).psnr == pytest.approx(-10 * math.log10(mse), rel=1e-5)
    assert measure_step(training, done).psnr != pytest.approx(-10 * math.log10(mse), rel=1e-5)
    assert measure_step(training, replace(done, mask=torch.zeros_like(half))).psnr is None


def test_steps_tell_the_balance_of_the_experts(folder):
    steps = [e for e in events(config(), folder, stop_at=60, log_every=1) if isinstance(e, Stepped)]  # dense to iteration 30
    for e in steps:
        assert set(e.balance) == set(e.entropy) == {"opacity", "cov", "color"}
        assert all(1 - 1e-5 <= v <= 5 for v in e.balance.values()) or e.step > 30
        assert all(0 <= v <= 1 + 1e-6 for v in e.entropy.values())
    dense, sparse = steps[29], steps[30]
    assert sum(dense.balance.values()) == pytest.approx(dense.terms["load"] / 0.01, rel=1e-4)
    assert sum(sparse.balance.values()) == pytest.approx(sparse.terms["load"] / 0.01 / 2, rel=1e-4)


def test_the_routing_of_the_whole_scene_is_told_beside_the_views(folder, monkeypatch):
    def stepped():
        return [e for e in events(config(), folder, stop_at=20, log_every=10) if isinstance(e, Stepped)]

    for event in stepped():
        for shares in (event.scene_routing, event.scene_gates, event.routing):
            assert shares.keys() == {"opacity", "cov", "color"} and all(sum(v) == pytest.approx(1, abs=1e-3) for v in shares.values())
    monkeypatch.setattr("scene_experts.training.measure.ROUTED", 5)
    few = stepped()
    assert few[-1].scene_gates != event.scene_gates and few[-1].psnr == event.psnr  # a smaller sample, the same training
