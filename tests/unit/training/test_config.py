import json
from dataclasses import replace
from pathlib import Path

import pytest

from scene_experts.core.errors import InputError
from scene_experts.core.schedule import Every, Rate
from scene_experts.recipes import RECIPES
from scene_experts.training.config import Data, RunConfig, Train, check, expect_at_least, from_json, to_json


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
    with pytest.raises(InputError, match="at least 1 iteration"):
        replace(RECIPES["moe-gs"][1], iterations=0).scaled()


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
        ({"growth": {"type": "GrowAnchors", "scale_clamp": "never"}}, "config.growth.scale_clamp"),
        (
            {"scene": {"type": "Anchors", "decoder": {"type": "Transformer"}}},
            r"'Plain', 'Experts', .*'BalancedExperts'.* at config.scene.decoder, found 'Transformer'",
        ),
    ],
)
def test_errors_name_the_place(edit, message):
    with pytest.raises(InputError, match=message):
        from_json(Train, {"recipe": "x", **edit})


@pytest.mark.parametrize("name", list(RECIPES))
def test_recipes_are_possible(name):
    check(RECIPES[name][1])


def test_impossible_settings_name_their_flag():
    moe = RECIPES["moe-gs"][1]
    wrong = {
        "--iterations of at least 1, found 0": replace(moe, iterations=0),
        "--scene.F of at least 1": replace(moe, scene=replace(moe.scene, F=0)),
        "opacity, cov, color, found colour": replace(moe, scene=replace(moe.scene, add_dist=("cov", "colour"))),
        "color, found depth": replace(moe, scene=replace(moe.scene, decoder=replace(moe.scene.decoder, attributes=("depth",)))),
        "--rates.log-scaling": replace(moe, rates=replace(moe.rates, log_scaling=Rate(0.01, 0.0))),
        "--growth.adjust.interval": replace(moe, growth=replace(moe.growth, adjust=replace(moe.growth.adjust, interval=0))),
        "--growth.hierarchy-factor of at least 2": replace(moe, growth=replace(moe.growth, hierarchy_factor=0)),
        "--seed of at most": replace(moe, seed=2**63 - 1),
        "--loss.mean-opacity of at least 0, found -1": replace(moe, loss=replace(moe.loss, mean_opacity=-1.0)),
        "--loss.dssim of at most 1, found 2": replace(moe, loss=replace(moe.loss, dssim=2.0)),
        "--scene.decoder.warmup": replace(moe, scene=replace(moe.scene, decoder=replace(moe.scene.decoder, warmup=-1))),
    }
    for said, cfg in wrong.items():
        with pytest.raises(InputError, match=said):
            check(cfg)
    check(replace(moe, rates=replace(moe.rates, feature=Rate(0.0, 0.0))))
    with pytest.raises(InputError, match="--x of at least 0, found nan"):
        expect_at_least([("--x", float("nan"), 0)])
