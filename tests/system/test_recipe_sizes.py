"""Parameters of the networks and bytes of a row for every recipe, counted by hand.

Linear(in, 32) - ReLU - Linear(32, out) has 33 out + 32 (in + 1) parameters: with 35 inputs (32 features, 3 of a direction) opacity (10) has
1,482, covariance (70) 3,462, colour (30) 2,142, together 7,086. A router of E experts has 33 E: three of them and E experts have 7,185 E.
"""

import pytest

from scene_experts.evaluate.results import describe_size
from scene_experts.training.recipes import RECIPES
from support.scenes import start_scene

PLAIN, LAYER, EXPERT = 7086, 3 * (32 * 32 + 32), 7185
GRID = 2 * (17**3 + 24**3 + 14 * 2**15)  # levels of 16, 23, 33, ... cells; from the third on hashed into 2^15 rows
PARAMETERS = {
    "scaffold-gs": PLAIN,
    "scaffold-gs-opacity": PLAIN,
    "scaffold-gs-bank": PLAIN + 32 * 5 + 33 * 3,  # 4 inputs, 3 weights
    "moe-gs": 35_925,
    "octree-gs": PLAIN,
    "octree-moe-gs": 35_925,
    "moe-gs-no-cl": 35_925,
    "moe-gs-no-load": 35_925,
    "moe-gs-no-opacity": 35_925,
    "moe-gs-dist": 36_405,  # 32 more for each of 15 networks
    "moe-gs-posrouter": 35_925 + 3 * 3 * 5,
    "moe-gs-e3-no-load": 3 * EXPERT,
    "3dgs": 0,
    "3dgs-mcmc": 0,
    "sags": 4256 + 4448 + 4320 + 6336 + 2 * 96 + GRID,
    **{f"moe-gs-e{num}-{routing}": num * EXPERT for num in (2, 3, 4, 5) for routing in ("top1", "top2", "dense")},
    **{f"scaffold-gs-depth{depth}": PLAIN + (depth - 2) * LAYER for depth in (2, 3, 4, 5, 6)},
}
EXTRA = {  # of no paper that is compared
    "moe-gs-balance": 35_925 + 3 * 5,
    "scaffold-gs-wide": 3 * 160 * 36 + 161 * 110,  # 160 hidden units
    "scaffold-gs-dist": PLAIN + 32 * 3,
    "scene-experts": 5 * (3 * 64 * 36 + 65 * 110 + 3 * 36),  # 64 hidden units; routers see features and positions
    "one-network": 3 * 64 * 36 + 65 * 110,
    "scene-experts-one": 3 * 64 * 36 + 65 * 110,
    "scene-experts-wide": 3 * 320 * 36 + 321 * 110,
}
BYTES = {"3dgs": 248, "3dgs-mcmc": 248, "sags": 196}  # of a row; anchors of K = 10 and F = 32 take 316


def test_every_recipe_is_counted():
    assert PARAMETERS.keys() | EXTRA.keys() == RECIPES.keys()


@pytest.mark.parametrize("recipe", RECIPES)
def test_parameters_and_bytes(recipe):
    scene = start_scene(recipe)
    assert sum(tensor.numel() for tensor in scene.network_tensors().values()) == (PARAMETERS | EXTRA)[recipe]
    found = describe_size(scene)
    assert found["network_bytes"] == 4 * (PARAMETERS | EXTRA)[recipe]
    assert found["ply_bytes"] == BYTES.get(recipe, 316) * len(scene.table)
    assert found["MB"] == (found["ply_bytes"] + found["network_bytes"]) / 1e6


def test_with_and_without_the_distance_by_attribute():
    counts = {}
    for recipe in ("scaffold-gs", "moe-gs-dist"):
        tensors = start_scene(recipe).network_tensors()
        counts[recipe] = {
            a: sum(t.numel() for n, t in tensors.items() if n.startswith(f"{a}.") and "router" not in n)
            for a in ("opacity", "cov", "color")
        }
    assert counts == {
        "scaffold-gs": {"opacity": 1482, "cov": 3462, "color": 2142},
        "moe-gs-dist": {"opacity": 5 * 1514, "cov": 5 * 3494, "color": 5 * 2174},
    }
