"""Comparisons of any recipes: rows, baselines and the cells of their differences."""

import pytest

from scene_experts.core.errors import InputError
from scene_experts.reproduce.compare import COMPARE, make_comparison, make_difference_table, make_difference_tables
from scene_experts.reproduce.experiments import DATASETS
from scene_experts.reproduce.options import ReproduceOptions
from support.records import record


def test_the_first_recipe_is_the_baseline_unless_told_otherwise():
    recipes = ("moe-gs", "scaffold-gs", "moe-gs-balance")
    found = make_comparison(ReproduceOptions(("compare",), recipes=recipes))
    assert tuple(found.rows) == recipes and found.baselines == ("moe-gs",)
    assert all(found.shows(dataset, scene) for dataset, scenes in DATASETS.items() for scene in scenes)
    assert make_comparison(ReproduceOptions(("compare",), recipes=recipes, baseline=recipes[1:])).baselines == recipes[1:]


def test_one_table_for_each_baseline_and_score_that_the_records_have():
    runs = [record(r, s) for r in ("moe-gs", "scaffold-gs") for s in "xyz"]
    experiment = make_comparison(ReproduceOptions(("compare",), recipes=("moe-gs", "scaffold-gs"), baseline=("moe-gs", "scaffold-gs")))
    names = set(make_difference_tables(experiment, runs, "xyz"))  # the records have no LPIPS by view
    assert names == {f"{score} minus that of {recipe}" for score in ("PSNR", "SSIM") for recipe in ("moe-gs", "scaffold-gs")}


def test_cells():
    gains = {"x": 0.1, "y": 0.2, "z": 0.3}
    runs = [record("moe-gs", s, psnr=30 + g) for s, g in gains.items()] + [record("scaffold-gs", s, seed=k) for s in gains for k in (0, 1)]
    table = make_difference_table(runs, {r: r for r in ("scaffold-gs", "moe-gs")}, "scaffold-gs", "psnr", "xyz")
    ((name, *cells),) = table.rows
    assert name == "moe-gs" and cells[:4] == ["+0.10", "+0.20", "+0.30", "+0.20"] and cells[-1] == "-0.05 to +0.45"
    assert len(table.titles) == len(table.rows[0]) and "1 of the 2 seeds" in " ".join(table.notes)


def test_recipes_that_refine_poses_are_not_compared_with_others_by_other_scores():
    with pytest.raises(InputError, match="eval --align-poses"):
        make_comparison(ReproduceOptions((COMPARE,), recipes=("scaffold-gs", "refined=scaffold-gs --refine-poses")))
    both = ("a=scaffold-gs --refine-poses", "b=one-network --refine-poses")
    assert list(make_comparison(ReproduceOptions((COMPARE,), recipes=both)).rows) == ["a", "b"]
