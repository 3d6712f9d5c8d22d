"""Scenes as whole numbers: within half a step, and rounded twice the same."""

from dataclasses import replace

import pytest
import torch

from scene_experts.core.errors import InputError
from scene_experts.files.anchors.rounding import round_scene, rounded
from support.compact import K, make_scene


def test_values_are_within_half_a_step_and_round_to_themselves():
    data = make_scene(80, slots=torch.arange(80 * K).view(80, K) % 3 > 0, interval=torch.linspace(0, 3, 80), extra_level=torch.rand(80))
    once = rounded(data, data.precision)
    for name in ("feature", "log_scaling"):
        half = 0.5 * data.precision.steps[name] * 2.0 ** data.precision.classes[:, None]
        assert ((once.columns[name] - data.columns[name]).abs() <= half * 1.001).all()
    assert not once.columns["offsets"][~data.columns["slots"]].any() and torch.equal(once.columns["slots"], data.columns["slots"])
    assert once.cells is data.cells and torch.equal(once.columns["xyz"], data.columns["xyz"])
    twice = rounded(once, data.precision)
    assert all(torch.equal(twice.columns[name], once.columns[name]) for name in ("feature", "log_scaling", "offsets", "slots"))
    assert all(torch.equal(twice.networks[name], once.networks[name]) for name in once.networks)


def test_a_column_in_another_unit_is_as_precise_as_the_others():
    """The distance is 40 times as large as in training, and so are its steps."""
    data = make_scene(5)
    whole = round_scene(data).networks["cov.experts.w1"].values
    own, others = abs(whole[..., -1]).mean(), abs(whole[..., :-1]).mean()
    assert own < 3 * others


def test_large_weights_stay_below_two_to_the_20():
    data = make_scene(5)
    data.networks["color.experts.w2"][0, 0, 0] = 1e9
    whole = round_scene(data).networks["color.experts.w2"]
    assert abs(whole.values).max() <= 1 << 20 and whole.floats().max() == pytest.approx(1e9, rel=1e-5)


def test_values_too_large_for_their_steps():
    data = make_scene(5)
    steps = {**data.precision.steps, "offsets": torch.full((3 * K,), 1e-12)}
    with pytest.raises(InputError, match="--format anchors"):
        round_scene(replace(data, precision=replace(data.precision, steps=steps)))
