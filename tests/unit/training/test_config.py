from dataclasses import dataclass, replace

import pytest

from scene_experts.core.errors import InputError
from scene_experts.core.fields import NotNegative, check_fields
from scene_experts.core.schedule import Every, Rate
from scene_experts.scene.gaussians import ExplicitRates
from scene_experts.strategy.grow_octree import GrowOctree
from scene_experts.strategy.split_clone import SplitClone
from scene_experts.training.config import check, find_unused, with_numbers
from scene_experts.training.losses import Weights
from scene_experts.training.recipes import RECIPES
from support.messages import naming


@dataclass(frozen=True)
class Length:
    length: NotNegative = 0.0


def test_iterations_scale_windows_and_nothing_else():
    short = replace(RECIPES["moe-gs"][1], iterations=3000).scaled()
    assert short.growth.adjust == Every(150, 1500, 100) and short.growth.start_stat == 50
    assert short.scene.decoder.warmup == 150
    assert short.growth.success_threshold == 0.8 and short.growth.grad_threshold == 0.0002 and short.rates == RECIPES["moe-gs"][1].rates
    assert replace(short, iterations=30_000).growth.adjust.interval == 100
    assert RECIPES["moe-gs"][1].scaled() == RECIPES["moe-gs"][1]
    with pytest.raises(InputError, match="--iterations"):
        replace(RECIPES["moe-gs"][1], iterations=0).scaled()


@pytest.mark.parametrize("name", list(RECIPES))
def test_without_a_limit_of_the_run_the_limit_is_that_of_the_growth_rule(name):
    assert RECIPES[name][1].scaled().growth.max_anchors == (1_000_000 if name == "3dgs-mcmc" else 0)
    assert replace(RECIPES[name][1], max_anchors=7).scaled().growth.max_anchors == 7


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
    with pytest.raises(InputError, match=naming("--x.length", "nan")):
        check_fields(Length(float("nan")), "x")


@pytest.mark.parametrize(
    ("recipe", "part", "changes"),
    [
        ("scene-experts", "loss", {"load": 0.1, "mean_opacity": 0.1, "mean_size": 0.1}),
        ("scene-experts", "rates", {"router_scale": 2.0}),
        ("scaffold-gs", "loss", {"load": 0.1, "mean_size": 0.1}),
        ("3dgs", "loss", {"load": 0.1, "opacity": 0.1}),
        ("sags", "loss", {"load": 0.1, "mean_opacity": 0.1}),
    ],
)
def test_settings_without_an_effect_are_found_and_no_others(recipe, part, changes):
    cfg = RECIPES[recipe][1]
    used = replace(cfg.loss, dssim=0.3)
    for name, value in changes.items():
        changed = replace(cfg, **{"loss": used, part: replace(used if part == "loss" else cfg.rates, **{name: value})})
        assert find_unused(changed) == [f"--{part}.{name.replace('_', '-')}"]


IDLE = {
    "random_background_from": 10,
    "batch_rates": 1.0,
    "rates.anneal_from": 0.3,
    "rates.appearance": Rate(1.0, 0.1),
    "scene.few_views": 3,
    "scene.few_fall": (1, 2),
    "scene.dropout_full": 100,
    "loss.residual_weight": 0.5,
    "loss.residual_from": 100,
    "loss.tau": 0.3,
    "loss.opacity_from": 1000,
    "loss.opacity_until": 2000,
    "average.interval": 3,
}
ON = {
    "random_background": True,
    "batch": 2,
    "rates.anneal": 0.5,
    "scene.appearance": 4,
    "scene.dropout": 0.1,
    "loss.residual_quantile": 0.9,
    "loss.opacity": 0.1,
    "average.span": 0.1,
}


def test_settings_that_act_only_with_others_are_found_where_those_are_off():
    cfg, flags = RECIPES["scaffold-gs"][1], [f"--{place.replace('_', '-')}" for place in IDLE]
    assert sorted(find_unused(with_numbers(cfg, list(IDLE.items())))) == sorted(flags)
    assert find_unused(with_numbers(cfg, [*IDLE.items(), *ON.items()])) == []
    few = RECIPES["one-network"][1]
    off = with_numbers(few, [("scene.dropout", 0.0), ("scene.view_jitter", 0.0)])
    assert find_unused(off) and find_unused(off, few) == []  # nobody gave what the recipe has


@pytest.mark.parametrize("name", list(RECIPES))
def test_recipes_have_no_setting_without_an_effect(name):
    assert find_unused(RECIPES[name][1]) == []


def test_options_that_the_scene_or_a_loss_overrules_have_no_effect():
    scaffold, mcmc, plain = (RECIPES[name][1] for name in ("scaffold-gs", "3dgs-mcmc", "3dgs"))
    assert find_unused(replace(mcmc, sparse_adam=True)) == ["--sparse-adam"]  # its regularisers move every row
    assert find_unused(replace(plain, sparse_adam=True)) == find_unused(replace(scaffold, sparse_adam=True)) == []


def test_parts_that_do_not_fit_together_are_refused():
    moe = RECIPES["moe-gs"][1]
    for wrong, said in (
        (replace(moe, growth=SplitClone()), "growth rule for anchors, found one for Gaussians"),
        (replace(moe, growth=GrowOctree()), "growth rule for anchors, found one for anchors on levels"),
        (replace(moe, rates=ExplicitRates()), "rates for anchors, found those for gaussians"),
    ):
        with pytest.raises(InputError, match=said):
            check(wrong)


def test_a_part_that_nobody_registered_is_refused():
    @dataclass(frozen=True)
    class Unheard(Weights):
        pass

    with pytest.raises(InputError, match="Unheard"):
        check(replace(RECIPES["moe-gs"][1], loss=Unheard()))
