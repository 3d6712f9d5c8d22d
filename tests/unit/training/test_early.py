"""Photographs at half their size in the first iterations."""

from dataclasses import replace

import pytest

from scene_experts.core.errors import InputError
from scene_experts.data.settings import Data
from scene_experts.render import choose
from scene_experts.training import early
from scene_experts.training.config import RunConfig
from scene_experts.training.events import Stepped
from scene_experts.training.job import Job
from scene_experts.training.loop import iterate
from scene_experts.training.state import Training
from support.captures import load
from support.synthetic import make_capture
from support.trainings import assert_same, config, events, last_tensors


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return make_capture(tmp_path_factory.mktemp("early"), views=6, size=(48, 32)).folder


def test_only_large_photographs_are_seen_small_and_only_at_first(folder) -> None:
    camera = load(folder).views[0].camera
    large, tall = replace(camera, width=early.LEAST), replace(camera, height=early.LEAST + 1)
    cfg = replace(config(), half_until=15_000, iterations=1000).scaled()
    assert cfg.half_until == 500
    for seen in (large, tall):
        assert early.shrink(cfg, 500, seen) == (seen.shrunk(2), 2) and early.shrink(cfg, 501, seen) == (seen, 1)
    assert early.shrink(cfg, 1, camera) == (camera, 1)
    assert early.shrink(replace(cfg, half_until=0), 1, large) == (large, 1)


def test_a_training_sees_its_photographs_small_until_that_iteration(folder, monkeypatch) -> None:
    monkeypatch.setattr(early, "LEAST", 1)
    capture, heights = load(folder), {}
    for until in (0, 2):
        cfg = replace(config(), half_until=until, schedule=100, iterations=100)
        training, job = Training.start(cfg.scaled(), capture, "cpu"), Job(RunConfig(cfg, Data(folder)))
        done = [iterate(training, job, capture, choose("auto", "cpu")) for _ in range(3)]
        assert all(each.render.image.shape == each.target.shape for each in done)
        heights[until] = [each.target.shape[0] for each in done]
    first, second, third = heights[0]
    assert heights[2] == [first // 2, second // 2, third]
    capture.images.close()


def test_a_training_resumed_in_between_is_the_same_bit_for_bit(folder, tmp_path, monkeypatch) -> None:
    monkeypatch.setattr(early, "LEAST", 1)
    cfg = replace(config(), half_until=40, schedule=80, iterations=80)
    whole = list(events(cfg, folder, tmp_path / "whole", stop_at=60, log_every=10))
    assert any(isinstance(event, Stepped) and event.psnr > 5 for event in whole)
    list(events(cfg, folder, tmp_path / "parts", stop_at=30))
    list(events(cfg, folder, tmp_path / "parts", stop_at=60, resume=True))
    assert_same(last_tensors(tmp_path / "whole"), last_tensors(tmp_path / "parts"))


def test_a_negative_iteration_is_refused() -> None:
    from scene_experts.training.config import check

    with pytest.raises(InputError, match="--half-until"):
        check(replace(config(), half_until=-1))
