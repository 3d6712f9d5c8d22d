"""The rate of a training: bits of bins, gradients against finite differences, masks, resuming, and what is opened."""

import math
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from scene_experts.core.errors import InputError, RunError
from scene_experts.core.logistic import logistic_bits
from scene_experts.data.settings import Data
from scene_experts.native import library as native
from scene_experts.scene.anchors.quantise import HIGH_CLASS, KEEP, LOW_CLASS, ROUNDED
from scene_experts.training import run_folder
from scene_experts.training.config import RunConfig, check
from scene_experts.training.events import Stepped
from scene_experts.training.rate import EVERY, RateModel, RateTerm, first_iteration, values_of
from scene_experts.training.recipes import RECIPES
from scene_experts.training.shards import check_shard
from support.scenes import start_scene
from support.synthetic import make_capture
from support.trainings import assert_same, config, events, last_tensors


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    return make_capture(tmp_path_factory.mktemp("capture"), views=16).folder


METHODS = ("scene-experts", "moe-gs", "octree-gs", "scaffold-gs-bank")


def rated(recipe="scene-experts", rate=0.01, **changes):
    """A short training whose rate begins half way."""
    return config(recipe, iterations=24, rate=rate, **changes)


def test_each_value_sees_the_class_and_the_values_before_it():
    F, K = 3, 2
    model = RateModel(F, K).double()
    torch.manual_seed(0)
    with torch.no_grad():
        model.weights.normal_(0, 0.3)
        model.biases.normal_(0, 0.3)
        model.middle.normal_()
    values, classes = torch.randn(4, 15, dtype=torch.float64), torch.tensor([LOW_CLASS, 0, 1, HIGH_CLASS])
    log_steps = torch.full((4, 15), -1.0, dtype=torch.float64) + classes[:, None] * math.log(2)
    bits = model(values, log_steps, classes, torch.zeros(4, 15))
    for i in range(4):
        step = math.exp(-1) * 2.0 ** int(classes[i])
        x = torch.zeros(7 + F + 6, dtype=torch.float64)
        x[int(classes[i]) - LOW_CLASS] = 1
        own = torch.round(values[i, : F + 6] / step) * step - model.middle[: F + 6]
        for c in range(15):
            x[7:] = torch.where(torch.arange(F + 6) < c, own, 0.0)
            mean = model.middle[c] + (model.weights[0, c] @ x + model.biases[0, c] if c < F + 6 else 0.0)
            spread = model.weights[1, c] @ x + model.biases[1, c]
            wanted = logistic_bits((values[i, c] - mean) / step, spread - math.log(step))
            torch.testing.assert_close(bits[i, c], wanted)


def test_gradients_are_finite_differences():
    model, g = RateModel(2, 1).double(), torch.Generator().manual_seed(0)
    with torch.no_grad():
        model.weights.normal_(0, 0.2, generator=g)
    classes, noise = torch.tensor([0, 1, -1]), torch.rand(3, 11, generator=g, dtype=torch.float64) - 0.5
    values = torch.randn(3, 11, generator=g, dtype=torch.float64)
    context = values.clone()  # values that predict others are held: only those of the last channels are free
    free = (context[:, 8:]).clone().requires_grad_()
    log_steps = torch.full((3, 11), -1.5, dtype=torch.float64)
    total = lambda last: model(torch.cat([context[:, :8], last], 1), log_steps, classes, noise).sum()  # noqa: E731
    assert torch.autograd.gradcheck(total, [free])
    for parameter in (model.weights, model.biases):
        (exact,) = torch.autograd.grad(total(free.detach()), parameter)
        direction = torch.randn(parameter.shape, generator=g, dtype=torch.float64)
        before, ends = parameter.detach().clone(), []
        for side in (1e-5, -1e-5):
            parameter.data.copy_(before + side * direction)
            ends.append(float(total(free.detach()).detach()))
        parameter.data.copy_(before)
        assert float((exact * direction).sum()) == pytest.approx((ends[0] - ends[1]) / 2e-5, rel=1e-5)


def begun(weight=0.01):
    cfg = RECIPES["scaffold-gs"][1]
    scene, term = start_scene("scaffold-gs"), RateTerm(weight, 0, cfg.growth, 100)
    g = torch.Generator().manual_seed(0)
    for name in ROUNDED:
        value = scene.table.params[name].data
        value += 0.3 * torch.randn(value.shape, generator=g)
    term.begin(scene, {name: torch.rand(scene.table.params[name].shape, generator=g) for name in ROUNDED}, 1.0)
    return scene, term


def test_the_term_is_bits_per_value_and_its_gradients_are_added():
    scene, term = begun()
    keep = scene.table.params[KEEP]
    keep.data[0] = -1.0
    keep.data[1, 2:] = -1.0
    given = {name: torch.randn(p.shape) for name, p in scene.table.params.items()}
    for name, value in given.items():
        scene.table.params[name].grad = value.clone()
    found = term.add_gradients(scene, 7)
    added = {name: p.grad - given[name] for name, p in scene.table.params.items()}
    n, P = len(scene.table), 68  # few anchors: the sample is all of them
    assert not added["feature"][0].any() and not added["offsets"][1, 2:].any() and added["offsets"][1, :2].any()
    before = float(found)
    small = 1e-3 * added["offsets"].sign()
    scene.table.params["offsets"].data += small
    assert float(term.add_gradients(scene, 7)) - before == pytest.approx(float((added["offsets"] * small).sum()), rel=0.05)
    rounding = scene.rounding
    opened = rounding.open
    assert 0 < before * P / 0.01 < 2000 and int(opened.any(1).sum()) == n - 1
    assert (added[KEEP] > 0).all() and float(added[KEEP][1, 0]) > float(
        added[KEEP][2, 0]
    )  # two slots share the price of an anchor, not ten


def test_it_begins_where_growth_ends_or_half_way():
    for recipe, wanted in (("scene-experts", 1400), ("octree-gs", None), ("scaffold-gs", 1400)):
        cfg = replace(RECIPES[recipe][1], iterations=3000).scaled()
        found = first_iteration(cfg.growth, 3000)
        assert found <= 1500 and (wanted is None or found == wanted)
    off = replace(RECIPES["scaffold-gs"][1].growth, enabled=False)
    assert first_iteration(off, 3000) == 1500


@pytest.mark.skipif(native.load() is None, reason="no compiled library")
@pytest.mark.parametrize(("recipe", "iterations"), [("scaffold-gs", 12), *(pytest.param(r, 80, marks=pytest.mark.slow) for r in METHODS)])
def test_resumed_equals_uninterrupted_bit_for_bit(recipe, iterations, folder, tmp_path, monkeypatch):
    monkeypatch.setattr("scene_experts.training.rate.EVERY", iterations // 4)
    cfg = config(recipe, iterations=iterations, rate=0.3, average=replace(RECIPES[recipe][1].average, span=0.2))
    seen = [e for e in events(cfg, folder, tmp_path / "whole", log_every=iterations // 4) if isinstance(e, Stepped)]
    assert ["rate" in e.terms for e in seen][::3] == [False, True]
    for stop in (iterations // 4, 3 * iterations // 4, iterations):
        list(events(cfg, folder, tmp_path / "parts", stop_at=stop, resume=stop > iterations // 4))
    assert_same(last_tensors(tmp_path / "whole"), last_tensors(tmp_path / "parts"))
    tensors = last_tensors(tmp_path / "whole")
    assert tensors["rate.biases"].any() and "average.params.keep" in tensors


@pytest.mark.parametrize("batch", [1, 4])
def test_an_opened_run_is_what_a_file_holds(batch, folder, tmp_path):
    cfg = rated("scaffold-gs", batch=batch)
    run_folder.prepare(tmp_path, RunConfig(cfg, Data(folder)), resume=False)
    list(events(cfg, folder, tmp_path))
    run = run_folder.open_run(tmp_path)
    steps = torch.cat(list(run.scene.steps.by_column(32).values()))
    values, factors = values_of(run.scene).double(), 2.0 ** run.scene.table.facts["class"][:, None].double()
    values[:, 32:38] -= math.log(run.scene.steps.scale)
    whole = values / steps.double() / factors
    assert float((whole - whole.round()).abs().max()) < 1e-3 and run.scene.rounding is None
    assert run.scene.table.facts["slots"].any(1).all()


def test_without_it_nothing_changes_and_what_cannot_have_it_says_so(folder):
    plain, same = ([e.terms for e in events(cfg, folder, stop_at=20) if isinstance(e, Stepped)] for cfg in (config(), config(rate=0.0)))
    assert plain == same
    with pytest.raises(InputError, match="anchors for --rate"):
        check(replace(RECIPES["3dgs"][1], rate=0.1))
    with pytest.raises(InputError, match="--rate"):
        check_shard(replace(RECIPES["scaffold-gs"][1], rate=0.1), 0.0, viewer=False)
    scene, term = begun()
    assert term.drop_closed(scene, EVERY - 1, 1) == 0
    scene.table.params[KEEP].data[:9] = -1.0
    rows = len(scene.table)
    assert term.drop_closed(scene, EVERY, 1) == 9 and len(scene.table) == rows - 9
    scene.table.params[KEEP].data[:] = -1.0
    with pytest.raises(RunError, match="--rate"):
        term.drop_closed(scene, EVERY, 1)
