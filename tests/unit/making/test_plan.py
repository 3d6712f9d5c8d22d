"""The plan of a training: when another one pays, and what is said of one that has begun."""

from dataclasses import replace
from types import SimpleNamespace

from scene_experts.bench.advice import Advice
from scene_experts.core import checkpoint
from scene_experts.making.plan import TrainingPlan, describe_begun


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
