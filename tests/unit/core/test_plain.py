"""Configurations to plain JSON and back."""

import json
from pathlib import Path

import pytest

from scene_experts.core.errors import InputError
from scene_experts.core.plain import UnknownPart, differences, from_json, lean, to_json
from scene_experts.data.settings import Data
from scene_experts.training.config import RunConfig, Train
from scene_experts.training.recipes import RECIPES
from support.messages import naming


@pytest.mark.parametrize("name", list(RECIPES))
def test_every_recipe_survives_json(name):
    config = RunConfig(RECIPES[name][1], Data(Path("somewhere"), background=(0.0, 0.5, 1.0)), "a command", True, 7, {"torch": "x"})
    assert from_json(RunConfig, json.loads(json.dumps(to_json(config)))) == config
    assert config.train.recipe == name


@pytest.mark.parametrize(
    ("edit", "message"),
    [
        ({"iterations": "many"}, "config.iterations"),
        ({"unheard_of": 1}, "unheard_of"),
        (
            {"rates": {"type": "Rates", "mix": {"type": "Rate", "first": 0.1}}},
            r"the keys \['first', 'last'\] at config.rates.mix, found \['first'\]",
        ),
        ({"scene": 3}, "config.scene"),
        ({"growth": {"type": "GrowAnchors", "gradient": "never"}}, "config.growth.gradient"),
        (
            {"scene": {"type": "Anchors", "decoder": {"type": "Transformer"}}},
            r"'Plain', 'Experts'.* at config.scene.decoder, found 'Transformer'",
        ),
    ],
)
def test_errors_name_the_place(edit, message):
    with pytest.raises(InputError, match=message):
        from_json(Train, {"recipe": "x", **edit})


def test_an_unknown_part_is_told_from_a_wrong_value():
    with pytest.raises(UnknownPart, match="MyScene"):
        from_json(Train, {"recipe": "x", "scene": {"type": "MyScene"}})
    with pytest.raises(UnknownPart, match=naming("config.scene", "GrowAnchors")):  # a part, but of another kind
        from_json(Train, {"recipe": "x", "scene": {"type": "GrowAnchors"}})


def test_differences_are_named():
    old, new = {"a": 1, "b": {"c": [1, 2], "d": 3}}, {"a": 1, "b": {"c": [1, 2], "d": 4}}
    assert differences(old, new) == ["b.d was 3, is now 4"] and differences(old, old) == []


@pytest.mark.parametrize("name", list(RECIPES))
def test_what_differs_from_the_defaults_says_everything(name):
    cfg = RECIPES[name][1]
    short = json.loads(json.dumps(lean(cfg)))
    assert from_json(Train, short) == cfg and len(json.dumps(short)) < len(json.dumps(to_json(cfg))) / 3
