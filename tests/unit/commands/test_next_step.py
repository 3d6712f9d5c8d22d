"""The proposed training is a command that `train` understands."""

import shlex
from dataclasses import replace
from pathlib import Path

from scene_experts.commands.next_step import propose_training
from scene_experts.commands.train import parse_train
from scene_experts.data.settings import Data


def test_the_command_is_one_of_train_with_its_time(monkeypatch):
    monkeypatch.setattr("scene_experts.bench.machine.measure_share", lambda threads: 1.0)
    line = propose_training(Data(Path("a folder")), 640, 480, 50)
    assert line.startswith("next: scene-experts train one-network --data 'a folder' --out RUN") and "min on this machine" in line
    words = shlex.split(line.partition("  #")[0])[3:]
    assert parse_train(words).out == Path("RUN")


def test_the_command_reads_the_capture_as_info_did():
    read = Data(Path("c"), images="photos", missing="drop", split="none", init="random", normalise="none", background=(0.0, 0.5, 1.0))
    words = shlex.split(propose_training(replace(read, resolution="factor:2"), 640, 480, 50).partition("  #")[0])[3:]
    assert replace(parse_train(words).data, resolution="auto") == read
    of_catalog = Data(Path("catalog:bonsai"), normalise="none")
    assert "--normalise" not in propose_training(of_catalog, 640, 480, 50)
