"""Hashes that released versions wrote into checkpoints."""

from dataclasses import replace

import pytest

from scene_experts.core.schedule import Every
from scene_experts.training.old_hash import old_hash
from scene_experts.training.optim import Adam
from scene_experts.training.recipes import RECIPES

FIRST = {"scaffold-gs": "f304f3c44732921f", "moe-gs": "536629188212acee"}  # of 30,000 iterations
SHORT = {  # of 40 iterations, densification every 4
    "3dgs": "9132073df03a07d3",
    "3dgs-mcmc": "8262249e2aecfc0e",
    "moe-gs": "41b2ca00227e88ae",
    "moe-gs-balance": "cb3956afaa2dced6",
    "octree-moe-gs": "c97bfac0983c236b",
    "sags": "39d20ba4f05b0d22",
    "scaffold-gs": "3e547b310133b5d8",
    "scaffold-gs-bank": "445bf470561c5e50",
    "scaffold-gs-depth3": "4b2684621169f2c6",
}


def short(recipe: str):
    cfg = RECIPES[recipe][1]
    adjust = replace(cfg.growth.adjust, interval=4)
    return replace(cfg, iterations=40, growth=replace(cfg.growth, adjust=adjust))


@pytest.mark.parametrize("recipe", FIRST)
def test_the_first_checkpoints_fit(recipe):
    assert old_hash(RECIPES[recipe][1].scaled()) == FIRST[recipe]


@pytest.mark.parametrize("recipe", SHORT)
def test_every_family_fits(recipe):
    assert old_hash(short(recipe).scaled()) == SHORT[recipe]


def test_other_settings_do_not_fit():
    cfg = RECIPES["moe-gs"][1]
    others = [
        replace(cfg, sparse_adam=True),
        replace(cfg, optimizer=Adam(eps=1e-8)),
        replace(cfg, growth=replace(cfg.growth, adjust=Every(1500, 15_000, 50))),
    ]
    assert all(old_hash(other.scaled()) != FIRST["moe-gs"] for other in others)
