"""Recipes with changed numbers."""

import numpy as np
import pytest

import scene_experts as se
from scene_experts.scene.anchors.balance import Balanced
from scene_experts.training.recipes import RECIPES


def test_a_recipe_without_numbers_is_the_recipe():
    assert se.recipe("moe-gs") == RECIPES["moe-gs"][1] and se.list_recipes().keys() == RECIPES.keys()
    assert isinstance(se.recipe("sags"), se.Recipe)


def test_numbers_go_where_their_names_say():
    made = se.recipe(
        "moe-gs", iterations=3000, scene={"voxel_size": 0.02, "decoder": {"num": 3}}, **{"loss.load": 1, "rates.mix.first": 0.5}
    )
    assert (made.iterations, made.scene.voxel_size, made.scene.decoder.num) == (3000, 0.02, 3)  # type: ignore[union-attr]
    assert made.loss.load == 1.0 and isinstance(made.loss.load, float) and made.rates.mix.first == 0.5  # type: ignore[union-attr]
    again = se.recipe(made, seed=np.int64(7), **{"scene.voxel-size": np.float32(0.5), "scene.add_dist": ("color",)})
    assert (again.seed, again.scene.voxel_size, again.scene.add_dist) == (7, 0.5, ("color",))  # type: ignore[union-attr]
    assert again.iterations == 3000 and type(again.seed) is int
    assert se.recipe("moe-gs", scene=made.scene).scene == made.scene, "a whole part"


@pytest.mark.parametrize(
    ("name", "numbers", "said"),
    [
        ("moegs", {}, "did you mean 'moe-gs'"),
        ("moe-gs", {"iteration": 5}, "did you mean 'iterations'"),
        ("moe-gs", {"scene.voxelsize": 5}, "scene.voxel_size"),
        ("moe-gs", {"scene": {"voxel": {"size": 1}}}, "scene.voxel.size"),
        ("moe-gs", {"recipe": "mine"}, "no 'recipe'"),
        ("moe-gs", {"iterations": "many"}, "iterations"),
        ("moe-gs", {"iterations": 2.5}, "iterations"),
        ("moe-gs", {"antialias": 1}, "antialias"),
        ("moe-gs", {"scene.add_dist": "color"}, "scene.add_dist"),
        ("moe-gs", {"iterations": 0}, "iterations"),
        ("moe-gs", {"seed": -1}, "seed"),
        ("moe-gs", {"rates.mix.first": float("inf")}, "--rates.mix.first as a finite number"),
        ("3dgs", {"scene.voxel_size": 0.1}, "'3dgs' has no"),
    ],
)
def test_what_does_not_fit_is_told_in_a_sentence(name, numbers, said):
    with pytest.raises(se.InputError, match=said) as error:
        se.recipe(name, **numbers)
    assert "\n" not in str(error.value)


def test_a_part_is_chosen_by_the_name_of_the_command_line_before_its_numbers_are_set():
    made = se.recipe("moe-gs-posrouter", **{"scene.decoder.router.speed": 0.1, "scene.decoder.router": "balanced"})
    assert made.scene.decoder.router == Balanced(input_pos=True, speed=0.1)  # type: ignore[union-attr]
    with pytest.raises(se.InputError, match=r"scene.decoder.router among linear, margin.*'balance'"):
        se.recipe("moe-gs", scene={"decoder": {"router": "balance"}})
