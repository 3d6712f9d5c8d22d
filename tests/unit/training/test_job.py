"""What a training is asked to do."""

from dataclasses import replace

import pytest

from scene_experts.data.settings import Data
from scene_experts.training.config import RunConfig
from scene_experts.training.job import Job, last_iteration
from support.trainings import config


@pytest.mark.parametrize(("stop_at", "batch", "expected"), [(None, 1, 40), (10, 1, 10), (10, 4, 12), (100, 4, 40)])
def test_a_training_ends_at_the_end_of_a_batch(stop_at, batch, expected, tmp_path):
    cfg = replace(config("scaffold-gs", iterations=40), batch=batch)
    assert last_iteration(cfg, Job(RunConfig(cfg, Data(tmp_path), stop_at=stop_at))) == expected
