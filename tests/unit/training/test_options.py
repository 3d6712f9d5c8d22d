"""Options of a training: one list for the command, the Python API and the loop."""

import dataclasses

import pytest

from scene_experts.commands.train import TrainCommand
from scene_experts.core.errors import InputError
from scene_experts.core.fields import check_fields
from scene_experts.training.job import Job
from scene_experts.training.options import TrainOptions


@pytest.mark.parametrize("wrong", [{"save_every": 0}, {"preview_every": -1}, {"log_every": 0}, {"stop_at": 0}, {"max_memory": -1.0}])
def test_invalid_options_are_named(wrong):
    (name,) = wrong
    with pytest.raises(InputError, match=f"--{name.replace('_', '-')}"):
        check_fields(TrainOptions(**wrong))


def test_no_option_is_stated_a_second_time():
    own = {field.name for field in dataclasses.fields(TrainOptions)}
    for kind in (TrainCommand, Job):
        assert own & {field.name for field in dataclasses.fields(kind)} <= {"device"}  # a `Job` has the one that was chosen
