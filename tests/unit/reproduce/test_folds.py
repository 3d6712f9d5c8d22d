"""Every photograph held out once: the runs, and their records as one."""

from dataclasses import replace
from pathlib import Path

import pytest

from scene_experts import cli
from scene_experts.data.settings import Data
from scene_experts.reproduce import store
from scene_experts.reproduce.claims import busiest
from scene_experts.reproduce.folds import check_folds, find_incomplete, hold_out_each, join
from scene_experts.reproduce.plan import CaptureSpec
from scene_experts.reproduce.statistics import difference
from support.records import record
from support.synthetic import make_capture


def parts(recipe="moe-gs", folds=3, sizes=(2, 1, 1), psnr=30.0, **how):
    """Records of the folds; fold k scores psnr + k + its view's number."""
    made = []
    for k, size in zip(range(1, folds + 1), sizes):
        one = record(recipe, psnr=psnr + k, views=size, mb=10.0 * k, **how)
        data = Data(Path("fox"), split=f"fold:{k}/{folds}")
        per_view = {f"{k}-{name}": scores for name, scores in one.per_view.items()}
        made.append(replace(one, config=replace(one.config, data=data), per_view=per_view))
    return made


def test_each_capture_is_trained_once_for_each_fold():
    scenes = [CaptureSpec(name, "captures", Path(name), {"normalise": "none", "split": "mod8"}) for name in ("fox", "fern")]
    found = hold_out_each(scenes, 2)
    assert [(s.name, s.options["split"]) for s in found] == [(n, f"fold:{k}/2") for n in ("fox", "fern") for k in (1, 2)]
    assert all(s.options["normalise"] == "none" for s in found)


def test_the_joined_record_has_the_scores_of_all_views_and_the_means_of_the_rest():
    (joined,) = join(parts(experts={"cov": {"share": [0.5, 0.5]}}, odd="same", other=None), 3)
    assert len(joined.per_view) == 4 and joined.results["view_count"] == 4
    assert joined.results["psnr"] == pytest.approx((31 + 32 + 32 + 33) / 4)  # over views, not over folds
    assert joined.value("size_mb") == pytest.approx(20) and joined.results["experts"]["cov"]["share"] == [0.5, 0.5]
    assert joined.results["odd"] == "same" and joined.results["other"] is None and joined.value("lpips") is None


def test_experts_of_folds_are_joined_by_rank_and_not_by_number():
    shares = ([0.9, 0.05, 0.05], [0.05, 0.9, 0.05], [0.05, 0.05, 0.9])
    made = [replace(one, results={**one.results, "experts": {"cov": {"share": s, "first": s, "k": 2}}}) for one, s in zip(parts(), shares)]
    (joined,) = join(made, 3)
    ranked = pytest.approx([0.9, 0.05, 0.05])
    assert joined.results["experts"]["cov"] == {"share": ranked, "first": ranked, "k": 2}
    assert busiest(joined) == pytest.approx(2.7)


def test_a_view_that_is_masked_wholly_has_no_part_in_the_means():
    made = parts()
    made[0] = replace(made[0], per_view={**made[0].per_view, "masked": {}})
    (joined,) = join(made, 3)
    assert joined.results["psnr"] == pytest.approx((31 + 32 + 32 + 33) / 4) and joined.results["view_count"] == 5
    without = {name: {key: value for key, value in view.items() if key != "ssim"} for name, view in made[1].per_view.items()}
    assert join([made[0], replace(made[1], per_view=without), made[2]], 3)[0].results["ssim"] is None


def test_a_training_without_one_of_its_folds_is_left_out():
    whole, part, other = parts(), parts(seed=1)[:2], parts("scaffold-gs", folds=2, sizes=(2, 2))
    assert [(r.recipe, r.seed) for r in join([*whole, *part, *other], 3)] == [("moe-gs", 0)]
    one, two = find_incomplete([*whole, *part, *other], 3)
    assert "moe-gs on" in one and "seed 1" in one and "1 of 3 folds are missing (3)" in one
    assert "scaffold-gs on" in two and "3 of 3 folds are missing" in two


def test_differences_are_paired_by_all_views():
    a, b = join(parts(psnr=31.0), 3), join(parts("scaffold-gs"), 3)
    found = difference(a, b)
    assert found.views == 4 and found.mean == pytest.approx(1.0) and found.seeds == (1, 1)


def test_tables_of_folds(tmp_path, capsys):
    (tmp_path / "fox").mkdir()
    recipes = ("moe-gs", "scaffold-gs")
    for recipe in recipes:
        for one in parts(recipe, psnr=30.0 + (recipe == "moe-gs")):
            store.write(tmp_path / "out" / "records", one)
    args = ["--captures", str(tmp_path / "fox"), "--out", str(tmp_path / "out"), "--iterations", "3000", "--recipes", *recipes]
    assert cli.main(["reproduce", "compare", *args, "--baseline", "scaffold-gs", "--folds", "3", "--tables-only"]) == 0
    text = (tmp_path / "out" / "compare.md").read_text()
    assert "+1.00" in text and "33.00" in text  # 31 + (1 + 2 + 2 + 3) / 4 = 33
    assert "--folds 3" in (tmp_path / "out" / "README.md").read_text()


def test_more_folds_than_photographs_are_refused_before_a_training(tmp_path, capsys):
    folder = make_capture(tmp_path / "tiny", views=4, size=(24, 16), points=40).folder
    check_folds([CaptureSpec("tiny", "own", folder)], 4)
    words = [
        "reproduce",
        "compare",
        "--recipes",
        "3dgs",
        "scaffold-gs",
        "--captures",
        str(folder),
        "--out",
        str(tmp_path / "out"),
        "--dry-run",
    ]
    assert cli.main([*words, "--folds", "5"]) == 2 and "at least 5 photographs for --folds 5, found 4" in capsys.readouterr().err
    assert cli.main([*words, "--folds", "4"]) == 0
