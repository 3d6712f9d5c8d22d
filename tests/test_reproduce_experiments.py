"""The paper's inventory: every table and figure that holds numbers, each with recipes that exist and the paper's rows."""

import pytest

from scene_experts.evaluate.tables import paper
from scene_experts.reproduce.experiments import DATASETS, EXPERIMENTS


def test_all_of_the_paper_is_there():
    assert {"table1", "table2", "table3", "table4", "fig1b", "fig3", "fig5", "fig6", "fig7"} <= EXPERIMENTS.keys()
    assert sum(map(len, DATASETS.values())) == 17


@pytest.mark.parametrize("name", [n for n, e in EXPERIMENTS.items() if e.paper])
def test_rows_are_named_as_the_paper_names_them(name):
    experiment, section = EXPERIMENTS[name], paper()[EXPERIMENTS[name].paper]
    rows = section if "columns" not in section else section[experiment.datasets[0]]
    assert set(experiment.rows) == set(rows) - {"columns"}
    if "columns" in section:
        assert len(section["columns"]) == len(experiment.columns)


def test_a_figure_has_its_own_scenes():
    fig3 = EXPERIMENTS["fig3"]
    assert fig3.shows("BungeeNeRF", "quebec") and not fig3.shows("BungeeNeRF", "rome") and not fig3.shows("DeepBlending", "playroom")
    assert EXPERIMENTS["table1"].scenes_of("TanksAndTemples") == ("truck", "train")
