"""The plan of a training: when another one pays, and what is said of one that has begun."""

from dataclasses import replace
from shutil import copytree
from types import SimpleNamespace

import pytest

from scene_experts.api.capture import load_capture
from scene_experts.api.recipe import recipe
from scene_experts.bench import advice
from scene_experts.bench.advice import Advice
from scene_experts.core import checkpoint
from scene_experts.core.errors import InputError
from scene_experts.data.settings import Data
from scene_experts.making import plan
from scene_experts.making.budget import MOST_OF_FEW, TimeBudget
from scene_experts.making.plan import TrainingPlan, describe_begun
from scene_experts.training import run_folder
from scene_experts.training.config import RunConfig
from scene_experts.training.course import Course
from support.messages import naming
from support.synthetic import make_capture


def test_a_training_is_not_begun_anew_for_one_that_ends_later(tmp_path):
    whole = TrainingPlan(tmp_path, "none", (48, 32), None, SimpleNamespace(iterations=320), Advice(0, 320, 0.32))
    shortest = replace(whole, advice=Advice(0, 300, 0.3), slow=4.0)
    assert not whole.pays(shortest, 32) and whole.pays(shortest, 10)
    assert whole.pays(replace(shortest, advice=Advice(0, 900, 0.9), slow=0.5), 32)


def test_a_repeated_call_says_how_far_the_training_is(tmp_path):
    config = SimpleNamespace(train=SimpleNamespace(iterations=500), data=SimpleNamespace(resolution="auto"))
    assert "at iteration 0" in describe_begun(tmp_path, config)
    checkpoint.save(tmp_path / "checkpoints", 500, {}, {})
    told = describe_begun(tmp_path, config)
    assert "is complete: 500" in told and "--minutes" in told and str(tmp_path) in told


def test_on_cuda_a_plan_of_few_photographs_is_corrected_by_what_it_trains(tmp_path, monkeypatch):
    """Speeds of which the proposed 30,000 iterations and the most for few photographs tell differently."""
    monkeypatch.setattr(advice.gsplat_install, "is_likely", lambda: True)
    cameras = make_capture(tmp_path / "c", views=6, size=(24, 16), points=60).folder
    first = TrainingPlan(cameras, "none", (1200, 800), load_capture(cameras, split="none"), recipe("one-network")).fit(60.0)
    assert first.recipe.iterations == MOST_OF_FEW
    for speed, wanted in ((200, None), (60, 60), (20, 20)):  # iterations a second
        step = first.recipe.iterations // 10
        seconds = step / speed
        monkeypatch.setattr(plan, "find_course", lambda *_: Course(first.recipe.iterations))
        other = first.corrected(SimpleNamespace(step=step, seconds=seconds), 60.0 - seconds)
        if wanted is None:
            assert other is None or other.recipe.iterations >= first.recipe.iterations
        else:
            assert other is not None and other.recipe.iterations == pytest.approx(wanted * 60, rel=0.15)


def test_scores_hold_photographs_out_where_the_files_hold_none_out(tmp_path):
    folder = make_capture(tmp_path / "c", views=16, size=(24, 16), points=60).folder
    (folder / "train.txt").write_text("\n".join(path.name for path in sorted((folder / "images").iterdir())))
    made = plan.prepare(folder, tmp_path / "run", TimeBudget(60.0), True, lambda _: None)
    assert made.split == "mod8" and made.held == 2


def test_a_run_of_another_capture_is_named_and_one_of_a_copy_goes_on(tmp_path):
    one, other = (make_capture(tmp_path / name, views=views, size=(24, 16), points=60).folder for name, views in (("one", 6), ("other", 7)))
    run = tmp_path / "out" / "run"
    run_folder.prepare(run, RunConfig(recipe("one-network"), Data(one, split="none")), resume=False)
    said = []
    with pytest.raises(InputError, match=naming(other, one, "choose another --out")):
        plan.prepare(other, run, None, False, said.append)
    assert said == []
    copytree(one, tmp_path / "copy")
    assert all(plan.prepare(place, run, None, False, said.append).begun for place in (one, tmp_path / "copy"))
