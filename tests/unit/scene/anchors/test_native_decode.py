"""The native decode against a slow float64 decode written from the paper's equations, anchor by anchor, in value and gradient."""

from dataclasses import replace

import pytest
import torch

from scene_experts.core.types import Gaussians
from scene_experts.native import library as native
from scene_experts.scene.anchors import native_decode
from scene_experts.scene.anchors.mlp import CHANNELS, HeadWeights

pytestmark = pytest.mark.skipif(native.load() is None, reason="no compiled library")
ATTRIBUTES = ("opacity", "cov", "color")
ACTIVATIONS = {"opacity": torch.tanh, "cov": lambda y: y, "color": torch.sigmoid}
LEVELS = [level for level in native.list_levels() if native.find(level)]


def problem(A=70, N=100, K=4, F=8, H=16, E=3, k=2, distance=(), bias=True, seed=0, shuffled=False, depth=2, position=()):
    """Float64 inputs of a random scene; `k` is per attribute or one for all, 0 for a plain network."""
    g = torch.Generator().manual_seed(seed)
    randn = lambda *shape: torch.randn(*shape, generator=g, dtype=torch.float64).float().double()  # noqa: E731
    rows = torch.randperm(N, generator=g)[:A]
    columns = {"xyz": randn(N, 3), "feature": randn(N, F), "log_scaling": 0.5 * randn(N, 6) - 1, "offsets": randn(N, K, 3)}
    heads = {}
    for i, a in enumerate(ATTRIBUTES):
        mine = k[i] if isinstance(k, tuple) else k
        experts, D, out = (1 if mine == 0 else E), F + 3 + (a in distance), K * CHANNELS[a]
        heads[a] = HeadWeights(
            None if mine == 0 else randn(experts, F + 3 * (a in position)),
            None if mine == 0 or not bias else randn(experts),
            randn(experts, H, D) / 3,
            randn(experts, H) / 3,
            randn(experts, out, H) / 3,
            randn(experts, out) / 3,
            mine or None,
            randn(experts, depth - 2, H, H) / 3 if depth > 2 else None,
            randn(experts, depth - 2, H) / 3 if depth > 2 else None,
            a in position,
        )
    rows = rows if shuffled else rows.sort().values
    return rows, columns, torch.tensor([0.3, -0.2, 2.5], dtype=torch.float64), heads, {a: a in distance for a in ATTRIBUTES}


EXTENT = 3.0


def oracle(rows, columns, camera, heads, with_dist):
    """Section 3 of Scaffold-GS with eq. 3 - 5 of Scene Experts, one anchor after the other."""
    K = columns["offsets"].shape[1]
    parts = {name: [] for name in ("means", "quats", "scales", "opacities", "colors", "source")}
    raws, gates, chosen = [], {a: [] for a in ATTRIBUTES}, {a: [] for a in ATTRIBUTES}
    for row in rows.tolist():
        v = columns["xyz"][row] - camera
        f, distance = columns["feature"][row], v.norm()
        y = {}
        for a, h in heads.items():
            z = torch.cat([f, v / distance] + ([distance[None]] if with_dist[a] else []))

            def expert(e, a=a, h=h, z=z):
                u = (h.w1[e] @ z + h.b1[e]).relu()
                for w, b in [] if h.middle_w is None else zip(h.middle_w[e], h.middle_b[e]):
                    u = (w @ u + b).relu()
                return ACTIVATIONS[a](h.w2[e] @ u + h.b2[e])

            if h.router_w is None:
                y[a] = expert(0)
                continue
            seen = torch.cat([f, columns["xyz"][row] / EXTENT]) if h.position else f
            logits = h.router_w @ seen + (0 if h.router_b is None else h.router_b)
            g = logits.softmax(0)
            picked = range(len(g)) if h.k is None else sorted(range(len(g)), key=lambda e: (-float(logits[e].detach()), e))[: h.k]
            y[a] = sum(g[e] / sum(g[j] for j in picked) * expert(e) for e in picked)
            gates[a].append(g)
            chosen[a].append(list(picked))
        raws.append(y["opacity"])
        size = columns["log_scaling"][row].exp()
        for slot in range(K):
            sigma, cov = y["opacity"][slot], y["cov"][7 * slot : 7 * slot + 7]
            if sigma <= 0:
                continue
            parts["means"].append(columns["xyz"][row] + columns["offsets"][row, slot] * size[:3])
            parts["scales"].append(size[3:] * cov[:3].sigmoid())
            parts["quats"].append(cov[3:] / cov[3:].norm())
            parts["opacities"].append(sigma)
            parts["colors"].append(y["color"][3 * slot : 3 * slot + 3])
            parts["source"].append(torch.tensor(row * K + slot))
    stacked = Gaussians(**{name: torch.stack(values) for name, values in parts.items()})
    return (
        stacked,
        torch.stack(raws),
        {a: torch.stack(g) for a, g in gates.items() if g},
        {a: torch.tensor(c) for a, c in chosen.items() if c},
    )


def leaves(columns, heads):
    """What is differentiated, as fresh leaves by name, and the same structures made of them."""
    columns = {name: v.clone().requires_grad_(name != "xyz") for name, v in columns.items()}
    heads = {
        a: replace(h, **{n: v.clone().requires_grad_() for n, v in vars(h).items() if isinstance(v, torch.Tensor)})
        for a, h in heads.items()
    }
    named = {name: v for name, v in columns.items() if name != "xyz"}
    named |= {f"{a}.{n}": v for a, h in heads.items() for n, v in vars(h).items() if isinstance(v, torch.Tensor)}
    return columns, heads, named


def objective(gaussians, raw, gates, seed=5):
    """A random linear function of everything differentiable, so that every gradient is tried."""
    g = torch.Generator().manual_seed(seed)
    values = [
        gaussians.means,
        gaussians.quats,
        gaussians.scales,
        gaussians.opacities,
        gaussians.colors,
        raw,
        *(gates[a] for a in sorted(gates)),
    ]
    return sum((v * torch.randn(v.shape, generator=g, dtype=torch.float64).to(v.dtype)).sum() for v in values)


def single_precision(columns, heads):
    return {n: v.float() for n, v in columns.items()}, {
        a: replace(h, **{n: v.float() for n, v in vars(h).items() if isinstance(v, torch.Tensor)}) for a, h in heads.items()
    }


def run_native(rows, columns, camera, heads, with_dist, seed=5):
    columns, heads, named = leaves(*single_precision(columns, heads))
    gaussians, raw, routing = native_decode.decode(
        rows, columns["xyz"], columns["feature"], columns["log_scaling"], columns["offsets"], camera.float(), heads, with_dist, EXTENT
    )
    objective(gaussians, raw, {a: r.gates for a, r in routing.items()}, seed).backward()
    return gaussians, raw, routing, {n: v.grad for n, v in named.items()}


def compare(found, expected, tolerance=1e-5, name=""):
    expected = expected.detach()
    scale = float(expected.norm()) or 1.0
    assert found.shape == expected.shape
    assert float((found.detach().double() - expected).norm()) <= tolerance * scale, (
        f"{name} is off by {float((found.detach() - expected).norm()) / scale:.1e}"
    )


CASES = {
    "plain": {"k": 0},
    "top-2": {},
    "top-1": {"k": 1},
    "dense": {"k": None},
    "all chosen": {"k": 3},
    "five of sixteen": {"E": 16, "k": 5},
    "attributes differ": {"k": (0, 2, None)},
    "others differ": {"k": (None, 1, 0)},
    "with distance": {"distance": ATTRIBUTES},
    "one with distance": {"distance": ("cov",), "bias": False},
    "paper's sizes, several chunks": {"A": 600, "N": 640, "K": 10, "F": 32, "H": 32, "E": 5},
    "odd sizes": {"A": 37, "K": 3, "F": 7, "H": 19, "E": 4},
    "many slots": {"K": 40, "A": 9},
    "six layers": {"k": 0, "depth": 6},
    "three layers, experts": {"depth": 3, "H": 19},
    "routers that see positions": {"position": ATTRIBUTES},
    "one router that does": {"position": ("cov",), "F": 12, "distance": ("color",)},
    "rows in any order": {"shuffled": True},
    "one anchor": {"A": 1, "N": 1, "seed": 1},
}


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
    with pytest.raises(ValueError, match="k between"):
        call(heads=heads | {"cov": replace(heads["cov"], k=4)})
    with pytest.raises(IndexError, match="rows from 0 to 99"):
        call(rows=torch.tensor([3, 100]))
