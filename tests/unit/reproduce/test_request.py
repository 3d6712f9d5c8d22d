"""From options to experiments, scenes and runs."""

import pytest

from scene_experts.core.errors import InputError
from scene_experts.reproduce.options import ReproduceOptions
from scene_experts.reproduce.request import choose_experiments, choose_scenes, make_plan
from support.messages import naming


@pytest.mark.parametrize(
    ("given", "fact"),
    [
        ({"recipes": ("moe-gs",)}, "--recipes"),
        ({"recipes": ("moe-gs", "scafold-gs")}, "'scaffold-gs'"),
        ({"recipes": ("moe-gs", "scaffold-gs"), "baseline": ("3dgs",)}, "--baseline"),
    ],
)
def test_comparisons_that_cannot_be(given, fact):
    with pytest.raises(InputError, match=fact):
        choose_experiments(ReproduceOptions(("compare",), **given))


@pytest.mark.parametrize(
    ("recipe", "seed", "flag"),
    [("moe-gs --scene.hidden 0", 0, "--scene.hidden"), ("moe-gs --batch 4", 0, "--batch"), ("moe-gs --scene.hidden 16", 2**63, "--seed")],
)
def test_settings_that_train_refuses_are_refused_before_the_first_run(tmp_path, recipe, seed, flag):
    (tmp_path / "box").mkdir()
    (tmp_path / "box" / "transforms.json").touch()
    options = {"captures": (tmp_path / "box",), "out": tmp_path / "out", "iterations": 30, "seeds": (seed,)}
    with pytest.raises(InputError, match=naming(flag)):
        make_plan(ReproduceOptions(("compare",), recipes=("scaffold-gs", recipe), **options))
    assert len(make_plan(ReproduceOptions(("table1",), **{**options, "seeds": (0,)})).wanted) == 5


def test_a_baseline_needs_a_comparison():
    with pytest.raises(InputError, match="--baseline"):
        choose_experiments(ReproduceOptions(("table1",), recipes=("moe-gs", "scaffold-gs"), baseline=("moe-gs",)))


def test_names_that_are_none(tmp_path):
    (tmp_path / "box").mkdir()
    (tmp_path / "note").touch()
    with pytest.raises(InputError, match="'table1'"):
        choose_experiments(ReproduceOptions(("tabel1",)))
    with pytest.raises(InputError, match="table1, table2"):
        choose_experiments(ReproduceOptions(()))
    with pytest.raises(InputError, match=naming(tmp_path)):
        choose_scenes(ReproduceOptions(("table1",), data=tmp_path))
    with pytest.raises(InputError, match=naming("--scenes", "box", "bax")):
        choose_scenes(ReproduceOptions(("table1",), captures=(tmp_path / "box",), scenes=("bax",)))
    with pytest.raises(InputError, match=naming(tmp_path / "box")):
        make_plan(ReproduceOptions(("table1",), captures=(tmp_path / "box",), dry_run=True))
    with pytest.raises(InputError, match=naming(tmp_path / "note")):
        make_plan(ReproduceOptions(("table1",), captures=(tmp_path / "box",), out=tmp_path / "note"))
    with pytest.raises(InputError, match="'rome'"):
        choose_scenes(ReproduceOptions(("table1",), data=tmp_path, scenes=("roma",)))
    with pytest.raises(InputError, match="rome"):
        choose_scenes(ReproduceOptions(("table1",), data=tmp_path, scenes=("rome",)))
