"""Means, spreads and paired differences against numbers worked out by hand."""

import math
from dataclasses import replace

import numpy as np
import pytest

from scene_experts.reproduce.statistics import (
    SEED_SD,
    SEED_WEIGHT,
    complete_seeds,
    difference,
    estimate,
    estimate_over_captures,
    mean,
    on_common_scenes,
    student,
)
from support.records import record


def test_mean_over_scenes_spread_over_seeds():
    runs = [record(scene=s, seed=k, psnr=p, views=1) for s, k, p in (("a", 0, 30), ("b", 0, 20), ("a", 1, 32), ("b", 1, 22))]
    found = mean(runs, "psnr")
    assert found is not None and found.value == 26 and found.spread == pytest.approx(math.sqrt(2))
    one = mean(runs[:2], "psnr")
    assert one is not None and (one.value, one.spread) == (25, None)
    assert mean([], "psnr") is None and mean(runs, "nothing") is None


def test_a_seed_that_lacks_a_scene_does_not_move_the_mean():
    runs = [record(scene=s, seed=k, psnr=p, views=1) for s, k, p in (("a", 0, 30), ("b", 0, 20), ("a", 1, 99))]
    found = mean(runs, "psnr")
    assert found is not None and found.value == 25 and complete_seeds(runs) == {0}


def test_equal_gains_on_every_view_leave_the_doubt_of_other_seeds():
    a = [record("moe-gs", scene=s, seed=k, psnr=30.5) for s in "xy" for k in (0, 1)]
    b = [record("scaffold-gs", scene=s, seed=k, psnr=30.0) for s in "xy" for k in (0, 1)]
    d = difference(a, b)
    pooled = math.sqrt(SEED_WEIGHT * SEED_SD["psnr"] ** 2 / (SEED_WEIGHT + 2))  # seeds that agree lower it
    assert d is not None and d.mean == pytest.approx(0.5)
    assert d.high - 0.5 == pytest.approx(0.5 - d.low) == pytest.approx(student(SEED_WEIGHT + 2) * pooled / 2)
    assert (d.captures, d.seeds, d.views) == (2, (2, 2), 8)
    assert (d.verdict(1), d.verdict(-1)) == ("confirmed", "contradicted")


QUANTILES = [(1, 12.706205), (1.5, 6.016663), (2, 4.302653), (2.5, 3.574655), (4, 2.776445), (10, 2.228139), (1e9, 1.959964)]


@pytest.mark.parametrize(("freedom", "value"), QUANTILES)
def test_quantiles_of_student(freedom, value):
    assert student(freedom) == pytest.approx(value, rel=2e-6)


@pytest.mark.parametrize(("captures", "seeds", "views"), [(1, 1, 7), (7, 1, 9), (1, 2, 32), (7, 3, 9), (3, 3, 3)])
def test_intervals_hold_the_truth_as_often_as_they_say(captures, seeds, views):
    random, held = np.random.default_rng(0), 0
    for _ in range(600):
        truth = random.normal(0, 0.3, captures)
        seed = random.normal(0, SEED_SD["psnr"], (captures, seeds, 1))
        view = random.normal(0, 0.4, (captures, 1, views))
        rest = random.normal(0, 0.3, (captures, seeds, views))
        centre, half = estimate(list(truth[:, None, None] + seed + view + rest), SEED_SD["psnr"], 0.4)
        held += abs(centre - truth.mean()) <= half
    assert held / 600 >= 0.93


def test_the_interval_over_captures_is_students_of_their_means():
    found = estimate_over_captures([1.0, 2.0, 3.0])
    assert found == pytest.approx((2 - 4.302653 / math.sqrt(3), 2 + 4.302653 / math.sqrt(3)))
    assert estimate_over_captures([1.0, 2.0]) is None
    a = [record("moe-gs", scene=s, seed=k, psnr=30 + gain) for s, gain in zip("xyz", (1, 2, 3)) for k in (0, 1)]
    d = difference(a, [record("scaffold-gs", scene=s, seed=k) for s in "xyz" for k in (0, 1)])
    assert d is not None and d.by_capture == pytest.approx({"x": 1, "y": 2, "z": 3}) and d.over_captures == pytest.approx(found)


def test_the_interval_over_captures_holds_the_mean_of_all_captures_as_often_as_it_says():
    random = np.random.default_rng(0)
    ends = [estimate_over_captures(list(random.normal(0.2, 0.3, 7))) for _ in range(2000)]
    assert sum(low <= 0.2 <= high for low, high in ends) / 2000 == pytest.approx(0.95, abs=0.015)


def test_gains_here_and_losses_there_are_undecided():
    a, b = record("moe-gs"), record("scaffold-gs")
    for view, gain in zip(a.per_view, (1.0, -1.0, 0.9, -0.9)):
        a.per_view[view]["psnr"] += gain
    d = difference([a], [b])
    assert d is not None and abs(d.mean) < 1e-9 and d.low < 0 < d.high and d.verdict(1) == "undecided"


def test_one_view_alone_is_as_uncertain_as_views_are():
    d = difference([record("moe-gs", views=1, psnr=30.5)], [record("scaffold-gs", views=1)])
    assert d is not None and d.low < 0 < d.high < math.inf


def test_only_what_both_have_is_paired():
    assert difference([record(seed=0)], [record("scaffold-gs", seed=1)]) is None


def test_one_seed_leaves_room_for_what_another_would_change():
    a, b = ([record(recipe, scene=s, psnr=p) for s in "vwxyz"] for recipe, p in (("moe-gs", 30.5), ("scaffold-gs", 30.0)))
    one, five = difference(a[:1], b[:1]), difference(a, b)
    width = student(SEED_WEIGHT) * SEED_SD["psnr"]
    assert one is not None and one.low == pytest.approx(0.5 - width) and one.verdict(1) == "undecided"
    assert five is not None and five.low == pytest.approx(0.5 - width / math.sqrt(5)) and five.verdict(1) == "confirmed"


def test_fit_is_paired_by_run():
    a, b = (replace(record(recipe, scene="x"), fit=fit) for recipe, fit in (("moe-gs", 31.5), ("scaffold-gs", 31.0)))
    d = difference([a], [b])
    assert d is not None and d.fit == pytest.approx(0.5)
    other = replace(b, config=replace(b.config, train=replace(b.config.train, random_background=True)))
    d = difference([a], [other])  # random backgrounds change the order of the views
    assert d is not None and d.fit is None
    d = difference([a], [replace(b, fit=None)])
    assert d is not None and d.fit is None


def test_a_large_gain_on_one_of_three_captures_is_no_rule():
    a = [record("moe-gs", scene=s, psnr=p, seed=k) for s, p in (("x", 32.0), ("y", 29.9), ("z", 29.9)) for k in (0, 1)]
    b = [record("scaffold-gs", scene=s, seed=k) for s in "xyz" for k in (0, 1)]
    d = difference(a, b)
    assert d is not None and d.low > 0 and d.gains == 1 and d.verdict(1) == d.verdict(-1) == "undecided"


def test_shared_scenes_are_those_of_every_recipe_that_ran():
    runs = [record("moe-gs", scene="x"), record("moe-gs", scene="y"), record("scaffold-gs", scene="y")]
    assert [(r.recipe, r.scene) for r in on_common_scenes(runs, ["moe-gs", "scaffold-gs", "3dgs"])] == [
        ("moe-gs", "y"),
        ("scaffold-gs", "y"),
    ]
    assert on_common_scenes([], ["moe-gs"]) == []
