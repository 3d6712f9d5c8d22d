"""The command line that repeats a scripted training."""

import shlex
from dataclasses import replace
from pathlib import Path

import pytest

import scene_experts as se
from scene_experts.api.command_line import command_of
from scene_experts.commands.train import parse_train
from scene_experts.data.settings import Data
from scene_experts.training.options import TrainOptions

OUT = Path("a run")


@pytest.mark.parametrize(
    ("name", "numbers"),
    [
        ("moe-gs", {}),
        (
            "moe-gs",
            {"iterations": 7, "antialias": True, "scene.add_dist": ("color", "cov"), "scene.decoder.top_k": None},
        ),
        ("octree-moe-gs", {"scene.decoder.router.input_pos": True, "growth.adjust.interval": 7, "scene.voxel_size": 0.02}),
        ("sags", {"seed": 3}),
        ("3dgs-mcmc", {"sparse_adam": True, "rates.means.first": 0.01}),
        ("scaffold-gs-bank", {"scene.voxel_rule": "median_nn"}),
    ],
)
def test_the_command_makes_the_same_training(name, numbers):
    cfg = se.recipe(name, **numbers)
    data = Data(Path("my capture"), resolution="longest:64", max_views=5, ignore_principal_point=True, background=(0.0, 0.5, 1.0))
    words = shlex.split(command_of(cfg, data, OUT, TrainOptions(deterministic=True, stop_at=4)))
    command = parse_train(words[2:])
    assert words[:2] == ["scene-experts", "train"] and (command.cfg, command.data, command.out) == (cfg, data, OUT)
    assert command.options == TrainOptions(deterministic=True, stop_at=4)
    if not numbers:
        assert shlex.split(command_of(cfg, Data(Path("c")), OUT, TrainOptions())) == [*words[:3], "--data", "c", "--out", "a run"]


def test_what_no_command_can_say_is_left_empty():
    cfg, data = se.recipe("moe-gs"), Data(Path("c"))
    assert command_of(replace(cfg, recipe="mine"), data, OUT, TrainOptions()) == ""
    assert command_of(replace(cfg, scene=se.recipe("sags").scene), data, OUT, TrainOptions()) == ""
    assert command_of(cfg, data, None, TrainOptions()) == ""
    assert command_of(se.recipe("moe-gs", **{"loss.depth_until": 30_001}), data, OUT, TrainOptions()) == "", "no flag sets it"
    for names in (("a.jpg", "-b.jpg"), ("none",)):
        assert command_of(cfg, replace(data, leave_out=names), OUT, TrainOptions()) == ""


def test_names_that_look_like_flags_are_said_so_that_they_are_none():
    cfg = se.recipe("moe-gs", **{"loss.tau": -0.5, "loss.opacity": 0.1})
    data = replace(Data(Path("-x")), leave_out=("a b.jpg", "c.jpg"), background=(0.0, 0.5, 1.0))
    command = parse_train(shlex.split(command_of(cfg, data, Path("-o"), TrainOptions()))[2:])
    assert (command.cfg, command.data, command.out) == (cfg, data, Path("-o"))


def test_a_limit_of_memory_is_said():
    words = shlex.split(command_of(se.recipe("moe-gs"), Data(Path("c")), OUT, TrainOptions(max_memory=6.5)))
    assert parse_train(words[2:]).options.max_memory == 6.5
