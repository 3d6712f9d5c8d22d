import json
from dataclasses import replace
from pathlib import Path

import pytest

from scene_experts.core.errors import InputError
from scene_experts.core.schedule import Every, Rate
from scene_experts.recipes import RECIPES
from scene_experts.training.config import Data, RunConfig, Train, check, expect_at_least, from_json, to_json
from support.messages import naming


@pytest.mark.parametrize("name", list(RECIPES))
def test_every_recipe_survives_json(name):
    config = RunConfig(RECIPES[name][1], Data(Path("somewhere"), background=(0.0, 0.5, 1.0)), "a command", True, 7, {"torch": "x"})
    assert from_json(RunConfig, json.loads(json.dumps(to_json(config)))) == config
    assert config.train.recipe == name


def test_iterations_scale_windows_and_nothing_else():
    short = replace(RECIPES["moe-gs"][1], iterations=3000).scaled()
    assert short.growth.adjust == Every(150, 1500, 100) and short.growth.start_stat == 50
    assert short.scene.decoder.warmup == 150
    assert short.growth.success_threshold == 0.8 and short.growth.grad_threshold == 0.0002 and short.rates == RECIPES["moe-gs"][1].rates
    assert replace(short, iterations=30_000).growth.adjust.interval == 100
    assert RECIPES["moe-gs"][1].scaled() == RECIPES["moe-gs"][1]
    with pytest.raises(InputError, match="--iterations"):
        replace(RECIPES["moe-gs"][1], iterations=0).scaled()


@pytest.mark.parametrize(
    ("edit", "place"),
    [
        ({"iterations": "many"}, "config.iterations"),
        ({"unheard_of": 1}, "unheard_of"),
        (
            {"rates": {"type": "Rates", "mix": {"type": "Rate", "first": 0.1}}},
            "config.rates.mix",
        ),
        ({"scene": 3}, "config.scene"),
        ({"growth": {"type": "GrowAnchors", "scale_clamp": "never"}}, "config.growth.scale_clamp"),
        (
            {"scene": {"type": "Anchors", "decoder": {"type": "Transformer"}}},
            "config.scene.decoder.*Transformer",
        ),
    ],
)
def test_errors_name_the_place(edit, place):
    with pytest.raises(InputError, match=place):
        from_json(Train, {"recipe": "x", **edit})


@pytest.mark.parametrize("name", list(RECIPES))
def test_recipes_are_possible(name):
    check(RECIPES[name][1])


def test_impossible_settings_name_their_flag():
    moe = RECIPES["moe-gs"][1]
    wrong = {
        "--iterations": replace(moe, iterations=0),
        "--scene.F": replace(moe, scene=replace(moe.scene, F=0)),
        "colour": replace(moe, scene=replace(moe.scene, add_dist=("cov", "colour"))),
        "depth": replace(moe, scene=replace(moe.scene, decoder=replace(moe.scene.decoder, attributes=("depth",)))),
        "--rates.log-scaling": replace(moe, rates=replace(moe.rates, log_scaling=Rate(0.01, 0.0))),
        "--growth.adjust.interval": replace(moe, growth=replace(moe.growth, adjust=replace(moe.growth.adjust, interval=0))),
        "--growth.hierarchy-factor": replace(moe, growth=replace(moe.growth, hierarchy_factor=0)),
        "--seed": replace(moe, seed=2**63 - 1),
        "--loss.mean-opacity.*-1": replace(moe, loss=replace(moe.loss, mean_opacity=-1.0)),
        "--loss.dssim.*2": replace(moe, loss=replace(moe.loss, dssim=2.0)),
        "--scene.decoder.warmup": replace(moe, scene=replace(moe.scene, decoder=replace(moe.scene.decoder, warmup=-1))),
    }
    for said, cfg in wrong.items():
        with pytest.raises(InputError, match=said):
            check(cfg)
    check(replace(moe, rates=replace(moe.rates, feature=Rate(0.0, 0.0))))
    with pytest.raises(InputError, match=naming("--x", "nan")):
        expect_at_least([("--x", float("nan"), 0)])
