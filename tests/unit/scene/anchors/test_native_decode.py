"""The native decode against a slow float64 decode written from the paper's equations, anchor by anchor, in value and gradient."""

from dataclasses import replace

import pytest
import torch

from scene_experts.core.types import Routing
from scene_experts.native import library as native
from scene_experts.scene.anchors import native_decode
from scene_experts.scene.anchors.mlp import NOT_ROUTED
from support.decoding import CASES, EXTENT, OUTSIDE, compare, leaves, objective, oracle, problem, single_precision, without_routers
from support.messages import naming

pytestmark = pytest.mark.skipif(native.load() is None, reason="no compiled library")
LEVELS = [level for level in native.list_levels() if native.find(level)]


def run_native(rows, columns, camera, heads, with_dist, seed=5, outside=NOT_ROUTED):
    columns, heads, named = leaves(*single_precision(columns, heads))
    given = [columns[name] for name in ("xyz", "feature", "log_scaling", "offsets")]
    gaussians, raw, routing = native_decode.decode(rows, *given, camera.float(), heads, with_dist, EXTENT, outside)
    objective(gaussians, raw, {a: r.gates for a, r in routing.items() if a not in outside}, seed).backward()
    return gaussians, raw, routing, {n: v.grad for n, v in named.items()}


@pytest.mark.parametrize("case", CASES)
def test_value_and_gradient_are_the_equations(case):
    rows, columns, camera, heads, with_dist = problem(**CASES[case])
    exact_columns, exact_heads, named = leaves(columns, heads)
    expected, raw, gates, chosen = oracle(rows, exact_columns, camera, exact_heads, with_dist)
    objective(expected, raw, gates).backward()
    found, found_raw, routing, gradients = run_native(rows, columns, camera, heads, with_dist)
    assert torch.equal(found.source, expected.source)
    for name in ("means", "quats", "scales", "opacities", "colors"):
        compare(getattr(found, name), getattr(expected, name), name=name)
    compare(found_raw, raw, name="raw opacity")
    assert routing.keys() == gates.keys()
    for a, r in routing.items():
        compare(r.gates, gates[a], name=f"{a} gates")
        assert (r.chosen is None) == (heads[a].k is None)
        assert r.chosen is None or torch.equal(r.chosen, chosen[a])
    for name, leaf in named.items():
        compare(gradients[name], torch.zeros_like(leaf) if leaf.grad is None else leaf.grad, 1e-5, f"gradient of {name}")


@pytest.mark.parametrize("case", OUTSIDE)
def test_weights_from_outside_take_the_place_of_a_router(case):
    (sizes, attributes) = OUTSIDE[case]
    rows, columns, camera, heads, with_dist = problem(**sizes)
    heads, outside = without_routers(heads, len(rows), attributes)
    exact_columns, exact_heads, named = leaves(columns, heads)
    exact = {a: (r, w.clone().requires_grad_()) for a, (r, w) in outside.items()}
    expected, raw, gates, _ = oracle(rows, exact_columns, camera, exact_heads, with_dist, exact)
    objective(expected, raw, gates).backward()
    given = {a: (r, w.float().requires_grad_()) for a, (r, w) in outside.items()}
    found, found_raw, routing, gradients = run_native(rows, columns, camera, heads, with_dist, outside=given)
    assert torch.equal(found.source, expected.source) and all(routing[a] is given[a][0] for a in given)
    for name in ("means", "quats", "scales", "opacities", "colors"):
        compare(getattr(found, name), getattr(expected, name), name=name)
    compare(found_raw, raw, name="raw opacity")
    for a, (_, w) in given.items():
        compare(w.grad, exact[a][1].grad, 5e-5, f"gradient of the weights of {a}")
    for name, leaf in named.items():
        compare(gradients[name], torch.zeros_like(leaf) if leaf.grad is None else leaf.grad, 1e-5, f"gradient of {name}")


def test_weights_that_do_not_fit_are_refused():
    rows, columns, camera, heads, with_dist = problem()
    bare, outside = without_routers(heads, len(rows))
    floats = {a: (r, w.float()) for a, (r, w) in outside.items()}
    routing, weight = floats["cov"]
    for wrong, error in (
        ({}, ValueError),
        ({**floats, "cov": (routing, weight[:, :1])}, ValueError),
        ({**floats, "cov": (Routing(routing.gates, None), weight)}, ValueError),
        ({**floats, "cov": (Routing(routing.gates, routing.chosen + 3), weight)}, IndexError),
    ):
        with pytest.raises(error, match=r"cov|opacity"):
            run_native(rows, columns, camera, bare, with_dist, outside=wrong)
    with pytest.raises(ValueError, match="outside"):
        run_native(rows, columns, camera, heads, with_dist, outside=floats)


@pytest.mark.parametrize("case", ["top-2", "dense", "plain", "paper's sizes, several chunks", "odd sizes"])
@pytest.mark.parametrize("level", LEVELS)
def test_builds_agree_and_threads_change_nothing(level, case, monkeypatch):
    data = problem(**CASES[case])
    best = run_native(*data)
    library = native.load(level)
    monkeypatch.setattr(native, "load", lambda level=None: library)
    found = []
    for threads in (1, 3):
        monkeypatch.setattr(native, "count_threads", lambda n=threads: n)
        found.append(run_native(*data))
    compare(found[0][0].colors, best[0].colors.double(), name="colors")
    for name, gradient in found[0][3].items():
        compare(gradient, best[3][name].double(), 1e-5, name)
        assert torch.equal(gradient, found[1][3][name]), name


def test_ties_go_to_the_lowest_expert():
    rows, columns, camera, heads, with_dist = problem(E=5)
    for h in heads.values():
        h.router_w.zero_()
        h.router_b.copy_(torch.tensor([0.0, 1.0, 0.5, 1.0, 0.5]))
    _, _, routing, gradients = run_native(rows, columns, camera, heads, with_dist)
    assert all(r.chosen.tolist() == [[1, 3]] * len(rows) for r in routing.values())
    assert not gradients["cov.w1"][[0, 2, 4]].any() and gradients["cov.w1"][[1, 3]].any()


def test_nothing_seen_and_nothing_positive():
    rows, columns, camera, heads, with_dist = problem()
    gaussians, raw, routing, gradients = run_native(rows[:0], columns, camera, heads, with_dist)
    assert len(gaussians) == 0 and raw.shape == (0, 4) and routing["color"].gates.shape == (0, 3)
    assert all(g.shape and not g.any() for g in gradients.values())
    heads["opacity"].b2.fill_(-50.0)
    gaussians, raw, _, gradients = run_native(rows, columns, camera, heads, with_dist)
    assert len(gaussians) == 0 and (raw < 0).all() and not gradients["offsets"].any()


def test_masked_slots_are_revived_through_the_opacity_head():
    rows, columns, camera, heads, with_dist = problem()
    columns, heads, named = leaves(*single_precision(columns, heads))
    _, raw, _ = native_decode.decode(
        rows, columns["xyz"], columns["feature"], columns["log_scaling"], columns["offsets"], camera.float(), heads, with_dist, EXTENT
    )
    torch.relu(-raw).mean().backward()
    assert named["opacity.w2"].grad.any() and named["feature"].grad.any() and not named["color.w2"].grad.any()
    unseen = torch.ones(len(columns["feature"]), dtype=torch.bool)
    unseen[rows] = False
    assert not named["feature"].grad[unseen].any()


def test_tiny_opacities_keep_their_sign():
    rows, columns, camera, heads, with_dist = problem(k=0)
    for name in ("w2", "b2"):
        getattr(heads["opacity"], name).mul_(1e-12)
    gaussians, raw, _, _ = run_native(rows, columns, camera, heads, with_dist)
    expected, exact, _, _ = oracle(rows, columns, camera, heads, with_dist)
    assert torch.equal(gaussians.source, expected.source)
    compare(raw, exact)


@pytest.mark.parametrize("level", LEVELS)
def test_broken_features_break_values_not_memory(level, monkeypatch):
    library = native.load(level)
    monkeypatch.setattr(native, "load", lambda level=None: library)
    rows, columns, camera, heads, with_dist = problem()
    columns["feature"][::3] = float("nan")
    columns["feature"][1::3] = float("inf")
    _, raw, routing, _ = run_native(rows, columns, camera, heads, with_dist)
    assert all(((r.chosen >= 0) & (r.chosen < 3)).all() for r in routing.values()) and raw.isfinite().any() and raw.isnan().any()


def test_without_gradients():
    rows, columns, camera, heads, with_dist = problem()
    columns, heads = single_precision(columns, heads)
    with torch.no_grad():
        gaussians, raw, _ = native_decode.decode(
            rows, columns["xyz"], columns["feature"], columns["log_scaling"], columns["offsets"], camera.float(), heads, with_dist
        )
    assert not gaussians.means.requires_grad and not raw.requires_grad


def test_what_does_not_fit_is_refused():
    rows, columns, camera, heads, with_dist = problem()
    columns, heads = single_precision(columns, heads)
    call = lambda rows=rows, with_dist=with_dist, heads=heads, **c: native_decode.decode(  # noqa: E731
        rows, *[(columns | c)[n] for n in ("xyz", "feature", "log_scaling", "offsets")], camera.float(), heads, with_dist
    )
    with pytest.raises(ValueError, match=r"color\.w1"):
        call(with_dist={"opacity": False, "cov": False, "color": True})
    with pytest.raises(ValueError, match="float32"):
        call(feature=columns["feature"].double())
    with pytest.raises(ValueError, match=naming("cov", 3, 4)):
        call(heads=heads | {"cov": replace(heads["cov"], k=4)})
    with pytest.raises(IndexError, match=naming(99, 100)):
        call(rows=torch.tensor([3, 100]))
