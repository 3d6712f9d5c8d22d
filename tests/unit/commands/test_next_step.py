"""The proposed training is a command that `train` understands."""

import shlex
from pathlib import Path

from scene_experts.commands.next_step import propose_training
from scene_experts.commands.train import parse_train


def test_the_command_is_one_of_train_with_its_time():
    line = propose_training(Path("a folder"), 640, 480, 50)
    assert line.startswith("next: scene-experts train scene-experts --data 'a folder' --out RUN") and "min on this machine" in line
    words = shlex.split(line.partition("  #")[0])[3:]
    assert parse_train(words).out == Path("RUN")
