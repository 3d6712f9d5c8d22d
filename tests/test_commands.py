"""From flags to what the parts are given. The commands as a whole are in test_cli.py."""

from pathlib import Path

import pytest
import torch

from scene_experts import cli, commands
from scene_experts.commands import backend, check_settings, parse_train, positional
from scene_experts.errors import InputError
from scene_experts.recipes import RECIPES

PLACES = ["--data", "c", "--out", "r"]


def test_every_command_of_the_help_has_a_handler():
    assert commands.HANDLERS.keys() == cli.COMMANDS.keys()


@pytest.mark.parametrize("recipe", list(RECIPES))
def test_a_recipe_without_flags_is_the_recipe(recipe):
    made = parse_train([recipe, *PLACES])
    assert made.cfg == RECIPES[recipe][1] and (made.data.path, made.out) == (Path("c"), Path("r"))
    check_settings(made)


@pytest.mark.parametrize(
    ("flag", "value"),
    [
        ("--stop-at", "0"),
        ("--save-every", "0"),
        ("--preview-every", "-1"),
        ("--max-memory", "-1"),
        ("--max-memory", "nan"),
        ("--iterations", "0"),
        ("--seed", "-1"),
        ("--max-anchors", "-1"),
        ("--scene.K", "0"),
        ("--scene.voxel-size", "-0.1"),
        ("--growth.adjust.interval", "0"),
    ],
)
def test_numbers_no_training_can_have_name_their_flag(flag, value):
    with pytest.raises(InputError, match=f"expected {flag} of at least"):
        check_settings(parse_train(["moe-gs", *PLACES, flag, value]))


def test_the_device_and_rasteriser_that_were_asked_for(monkeypatch):
    device, rasterize = backend("cpu", "reference", True, False)
    assert device == "cpu" and rasterize.name == "reference" and rasterize.antialias  # type: ignore[attr-defined]
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    assert backend("auto", "reference", False, False)[0] == "cpu"
    with pytest.raises(InputError, match="expected a CUDA device, found none"):
        backend("cuda", "auto", False, False)


def test_the_first_word_may_stand_for_its_flag():
    assert positional(["folder", "--split", "none"], "--data") == ["--data", "folder", "--split", "none"]
    assert positional(["--data", "folder"], "--data") == ["--data", "folder"] and positional([], "--data") == []
