"""Recipes with flags: the settings, names and runs of a line."""

from dataclasses import replace
from pathlib import Path

import pytest

from scene_experts.core.errors import InputError
from scene_experts.reproduce.compare import make_comparison, make_difference_tables
from scene_experts.reproduce.options import ReproduceOptions
from scene_experts.reproduce.plan import CaptureSpec, Scale, Spec
from scene_experts.reproduce.request import make_plan, written_command
from scene_experts.reproduce.variants import read_line, split_name
from scene_experts.training.recipes import RECIPES
from support.records import record

LINE = "moe-gs --scene.hidden 8 --rates.anneal 0.1"
SCENE = CaptureSpec("x", "captures", Path("x"))


def test_a_recipe_without_flags_is_the_recipe():
    assert read_line("moe-gs") is RECIPES["moe-gs"][1]


def test_the_flags_change_the_recipe():
    cfg = read_line(LINE)
    assert (cfg.scene.hidden, cfg.rates.anneal, cfg.scene.decoder.num, cfg.recipe) == (8, 0.1, 5, LINE)


@pytest.mark.parametrize("text, name, line", [("moe-gs", "moe-gs", "moe-gs"), (LINE, LINE, LINE), (f"narrow = {LINE}", "narrow", LINE)])
def test_a_name_comes_before_the_line(text, name, line):
    assert split_name(text) == (name, line)


def test_an_equals_sign_of_a_flag_is_no_name():
    assert split_name("moe-gs --scene.hidden=8") == ("moe-gs --scene.hidden=8",) * 2
    assert split_name("=moe-gs") == ("=moe-gs",) * 2  # a row without a name is none


@pytest.mark.parametrize(
    "line, message",
    [
        ("moe", "moe"),
        ("", "--recipes"),
        ("moe-gs --scene.hidde 8", "--scene.hidde"),
        ("moe-gs --seed 1", "--seed"),
        ("moe-gs --iterations=5", "--iterations=5"),
        ("moe-gs --help", "--help-all"),
        ("moe-gs --split none", "found --split .* which all rows share; leave it out"),
        ("moe-gs --near=0.1", "found --near=0.1 "),
        ("moe-gs --stop-at 10", "found --stop-at "),
        ("moe-gs --scene.hidde 8", "expected an option of `scene-experts train moe-gs`"),
        ("moe-gs --scene.hidden '8", "quotes"),
    ],
)
def test_invalid_lines_are_refused(line, message):
    with pytest.raises(InputError, match=message):
        read_line(line)


def test_a_run_trains_the_recipe_with_its_flags_in_a_folder_of_the_recipe():
    spec, plain = Spec(SCENE, LINE, 1, Scale(iterations=90)), Spec(SCENE, "moe-gs", 1, Scale(iterations=90))
    words = spec.arguments(Path("out"))
    assert words[:2] == ["train", "moe-gs"] and words[-4:] == ["--scene.hidden", "8", "--rates.anneal", "0.1"]
    assert spec.folder(Path("r")).parent == plain.folder(Path("r")).parent and spec.numbers != plain.numbers
    assert spec.train.iterations == 90 and spec.train.seed == 1


def test_a_comparison_shows_the_names_and_its_command_quotes_the_lines(tmp_path):
    (tmp_path / "x").mkdir()
    options = ReproduceOptions(
        ("compare",),
        captures=(tmp_path / "x",),
        out=tmp_path / "out",
        recipes=("moe-gs", f"narrow={LINE}"),
        baseline=("narrow",),
        tables_only=True,
    )
    plan = make_plan(options)
    assert [spec.recipe for spec in plan.shown] == ["moe-gs", LINE]
    assert f"'narrow={LINE}' --baseline narrow" in written_command(options, plan.scenes)
    assert "--captures 'CAPTURES/my photos' --rec" in written_command(options, [replace(plan.scenes[0], name="my photos")])
    experiment = make_comparison(options)
    assert experiment.rows == {"moe-gs": "moe-gs", "narrow": LINE} and experiment.baselines == (LINE,)
    narrow = record("moe-gs", "x")
    narrow = replace(narrow, config=replace(narrow.config, train=read_line(LINE)))
    table = make_difference_tables(experiment, [record("moe-gs", "x"), narrow], ["x"])["PSNR minus that of narrow"]
    assert table.rows[0][0] == "moe-gs"


def test_two_recipes_of_one_name_are_refused():
    with pytest.raises(InputError, match="different"):
        make_comparison(ReproduceOptions(("compare",), recipes=("a=moe-gs", f"a={LINE}")))
