"""The paper's inventory: every table and figure that holds numbers, each with recipes that exist and the paper's rows."""

import pytest

from scene_experts.evaluate.tables import load_paper
from scene_experts.reproduce.experiments import DATASETS, EXPERIMENTS, OURS
from scene_experts.reproduce.options import ReproduceOptions
from scene_experts.reproduce.request import choose_experiments
from scene_experts.training.recipes import PROPOSED, RECIPES


def test_all_of_the_paper_is_there():
    assert {"table1", "table2", "table3", "table4", "fig1b", "fig3", "fig5", "fig6", "fig7"} <= EXPERIMENTS.keys()
    assert sum(map(len, DATASETS.values())) == 17


@pytest.mark.parametrize("name", [n for n, e in EXPERIMENTS.items() if e.paper])
def test_rows_are_named_as_the_paper_names_them(name):
    experiment, section = EXPERIMENTS[name], load_paper()[EXPERIMENTS[name].paper]
    rows = section if "columns" not in section else section[experiment.datasets[0]]
    assert set(experiment.rows) == set(rows) - {"columns"}
    if "columns" in section:
        assert len(section["columns"]) == len(experiment.columns)


def test_a_figure_has_its_own_scenes():
    fig3 = EXPERIMENTS["fig3"]
    assert fig3.shows("BungeeNeRF", "quebec") and not fig3.shows("BungeeNeRF", "rome") and not fig3.shows("DeepBlending", "playroom")
    assert EXPERIMENTS["table1"].scenes_of("TanksAndTemples") == ("truck", "train")


def test_all_is_what_the_paper_shows():
    names = {e.name for e in choose_experiments(ReproduceOptions(("all",)))}
    assert names == EXPERIMENTS.keys() - set(OURS) and "extras" in EXPERIMENTS
    grown_from = {"3dgs-mcmc": "3dgs", "scaffold-gs-bank": "scaffold-gs", "octree-moe-gs": "octree-gs"}
    recipes = set(EXPERIMENTS["extras"].rows.values())
    assert all({recipe, origin} <= recipes for recipe, origin in grown_from.items())


def test_every_recipe_but_the_walk_through_s_has_a_row():
    """docs/adding-a-method.md says of that one how to give it a row; its part is named nowhere but in its file and the recipes. The recipe
    for photographs of your own belongs to no comparison of papers."""
    assert RECIPES.keys() - {recipe for e in EXPERIMENTS.values() for recipe in e.rows.values()} == {"moe-gs-balance", PROPOSED}
