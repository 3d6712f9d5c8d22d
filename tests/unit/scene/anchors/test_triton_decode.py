"""The Triton decode against a slow float64 decode written from the paper's equations (that of test_native_decode.py), and against torch."""

from dataclasses import replace

import pytest
import torch

from scene_experts.core.table import Table
from scene_experts.core.types import Camera, Gaussians, Routing
from scene_experts.native.triton import explain_missing
from scene_experts.scene.anchors import decode as anchors
from scene_experts.scene.anchors import native_decode, triton_decode, triton_networks
from scene_experts.scene.anchors.experts import Experts
from scene_experts.scene.anchors.mlp import NOT_ROUTED, Plain
from scene_experts.scene.anchors.routers import Linear
from scene_experts.scene.anchors.scene import Anchors, AnchorScene
from support.decoding import CASES, EXTENT, OUTSIDE, compare, leaves, objective, oracle, problem, single_precision, without_routers
from support.interpret import DEVICE, decode_by_triton, kernels
from support.messages import naming

SMALL = {
    "paper's sizes, several chunks": {"A": 70, "N": 80},
    "odd sizes": {},
    "one anchor": {},
    "many slots": {},
}  # the interpreter is slow
PARTS = ("means", "quats", "scales", "opacities", "colors")


@pytest.fixture(scope="module")
def triton():
    with pytest.MonkeyPatch.context() as patch:
        if DEVICE == "cpu":
            patch.setattr(triton_networks, "BLOCK_WEIGHTS", 32)  # fewer programs to interpret
        yield kernels()


def moved(columns, heads, device=DEVICE):
    columns, heads = single_precision(columns, heads)
    tensors = lambda h: {n: v.to(device) for n, v in vars(h).items() if isinstance(v, torch.Tensor)}  # noqa: E731
    return {n: v.to(device) for n, v in columns.items()}, {a: replace(h, **tensors(h)) for a, h in heads.items()}


def call(rows, columns, camera, heads, with_dist, outside=NOT_ROUTED):
    c = [columns[n] for n in ("xyz", "feature", "log_scaling", "offsets")]
    return triton_decode.decode(rows.to(DEVICE), *c, camera.float().to(DEVICE), heads, with_dist, EXTENT, outside)


def run(rows, columns, camera, heads, with_dist, outside=NOT_ROUTED):
    """Outputs and gradients, on the CPU."""
    columns, heads, named = leaves(*moved(columns, heads))
    gaussians, raw, routing = call(rows, columns, camera, heads, with_dist, outside)
    g = Gaussians(**{n: getattr(gaussians, n).cpu() for n in (*PARTS, "source")})
    objective(g, raw.cpu(), {a: r.gates.cpu() for a, r in routing.items() if a not in outside}).backward()
    return g, raw.cpu(), routing, {n: v.grad.cpu() for n, v in named.items()}


@pytest.mark.usefixtures("triton")
@pytest.mark.parametrize("case", [name for name, case in CASES.items() if "depth" not in case])
def test_value_and_gradient_are_the_equations(case):
    rows, columns, camera, heads, with_dist = problem(**{**CASES[case], **SMALL.get(case, {"A": 40, "N": 50})})
    exact_columns, exact_heads, named = leaves(columns, heads)
    expected, raw, gates, chosen = oracle(rows, exact_columns, camera, exact_heads, with_dist)
    objective(expected, raw, gates).backward()
    found, found_raw, routing, gradients = run(rows, columns, camera, heads, with_dist)
    assert torch.equal(found.source, expected.source)
    for name in PARTS:
        compare(getattr(found, name), getattr(expected, name), name=name)
    compare(found_raw, raw, name="raw opacity")
    assert routing.keys() == gates.keys()
    for a, r in routing.items():
        compare(r.gates.cpu(), gates[a], name=f"{a} gates")
        assert (r.chosen is None) == (heads[a].k is None)
        assert r.chosen is None or torch.equal(r.chosen.cpu(), chosen[a])
    for name, leaf in named.items():
        compare(gradients[name], torch.zeros_like(leaf) if leaf.grad is None else leaf.grad, 1e-5, f"gradient of {name}")


@pytest.mark.usefixtures("triton")
@pytest.mark.parametrize("case", OUTSIDE)
def test_weights_from_outside_take_the_place_of_a_router(case):
    (sizes, attributes) = OUTSIDE[case]
    rows, columns, camera, heads, with_dist = problem(**{**sizes, "A": 34, "N": 40})
    heads, outside = without_routers(heads, len(rows), attributes)
    exact_columns, exact_heads, named = leaves(columns, heads)
    exact = {a: (r, w.clone().requires_grad_()) for a, (r, w) in outside.items()}
    expected, raw, gates, _ = oracle(rows, exact_columns, camera, exact_heads, with_dist, exact)
    objective(expected, raw, gates).backward()
    on = lambda r: Routing(r.gates.to(DEVICE), None if r.chosen is None else r.chosen.to(DEVICE))  # noqa: E731
    given = {a: (on(r), w.float().to(DEVICE).requires_grad_()) for a, (r, w) in outside.items()}
    found, found_raw, _, gradients = run(rows, columns, camera, heads, with_dist, given)
    assert torch.equal(found.source, expected.source)
    for name in PARTS:
        compare(getattr(found, name), getattr(expected, name), name=name)
    compare(found_raw, raw, name="raw opacity")
    for a, (_, w) in given.items():
        compare(w.grad.cpu(), exact[a][1].grad, 5e-5, f"gradient of the weights of {a}")
    for name, leaf in named.items():
        compare(gradients[name], torch.zeros_like(leaf) if leaf.grad is None else leaf.grad, 1e-5, f"gradient of {name}")


@pytest.mark.usefixtures("triton")
@pytest.mark.parametrize("E", [1, 2, 4, 5])
@pytest.mark.parametrize("k", [1, 2, None])
def test_every_number_of_experts(E, k):
    rows, columns, camera, heads, with_dist = problem(A=34, N=40, E=E, k=min(k, E) if k else k, seed=E)
    exact_columns, exact_heads, named = leaves(columns, heads)
    expected, raw, gates, _ = oracle(rows, exact_columns, camera, exact_heads, with_dist)
    objective(expected, raw, gates).backward()
    found, _, _, gradients = run(rows, columns, camera, heads, with_dist)
    compare(found.quats, expected.quats, name="quats")
    for name, leaf in named.items():
        compare(gradients[name], torch.zeros_like(leaf) if leaf.grad is None else leaf.grad, 1e-5, f"gradient of {name}")


@pytest.mark.usefixtures("triton")
def test_the_same_bits_again():
    data = problem(A=40, N=50, E=5)
    first, second = run(*data), run(*data)
    assert all(torch.equal(getattr(first[0], n), getattr(second[0], n)) for n in PARTS)
    assert all(torch.equal(g, second[3][n]) for n, g in first[3].items())


@pytest.mark.usefixtures("triton")
def test_ties_go_to_the_lowest_expert():
    rows, columns, camera, heads, with_dist = problem(A=20, E=5)
    for h in heads.values():
        h.router_w.zero_()
        h.router_b.copy_(torch.tensor([0.0, 1.0, 0.5, 1.0, 0.5]))
    _, _, routing, gradients = run(rows, columns, camera, heads, with_dist)
    assert all(r.chosen.tolist() == [[1, 3]] * len(rows) for r in routing.values())
    assert not gradients["cov.w1"][[0, 2, 4]].any() and gradients["cov.w1"][[1, 3]].any()


@pytest.mark.usefixtures("triton")
def test_nothing_seen_and_nothing_positive():
    rows, columns, camera, heads, with_dist = problem(A=20)
    gaussians, raw, routing, gradients = run(rows[:0], columns, camera, heads, with_dist)
    assert len(gaussians) == 0 and raw.shape == (0, 4) and routing["color"].gates.shape == (0, 3)
    assert all(g.shape and not g.any() for g in gradients.values())
    heads["opacity"].b2.fill_(-50.0)
    gaussians, raw, _, gradients = run(rows, columns, camera, heads, with_dist)
    assert len(gaussians) == 0 and (raw < 0).all() and not gradients["offsets"].any()


@pytest.mark.usefixtures("triton")
def test_masked_slots_are_revived_through_the_opacity_head():
    rows, columns, camera, heads, with_dist = problem(A=20)
    columns, heads, named = leaves(*moved(columns, heads))
    _, raw, _ = call(rows, columns, camera, heads, with_dist)
    torch.relu(-raw).mean().backward()
    assert named["opacity.w2"].grad.any() and named["feature"].grad.any() and not named["color.w2"].grad.any()
    unseen = torch.ones(len(columns["feature"]), dtype=torch.bool)
    unseen[rows] = False
    assert not named["feature"].grad.cpu()[unseen].any()


@pytest.mark.usefixtures("triton")
def test_tiny_opacities_keep_their_sign():
    rows, columns, camera, heads, with_dist = problem(A=20, k=0)
    for name in ("w2", "b2"):
        getattr(heads["opacity"], name).mul_(1e-12)
    gaussians, raw, _, _ = run(rows, columns, camera, heads, with_dist)
    expected, exact, _, _ = oracle(rows, columns, camera, heads, with_dist)
    assert torch.equal(gaussians.source, expected.source)
    compare(raw, exact)


@pytest.mark.usefixtures("triton")
@pytest.mark.filterwarnings("ignore:.*(invalid value|overflow).*:RuntimeWarning")
def test_broken_features_break_their_own_anchor_only():
    rows, columns, camera, heads, with_dist = problem(A=40)
    _, good_raw, _, _ = run(rows, columns, camera, heads, with_dist)
    broken = rows[::3]
    columns["feature"][broken] = float("nan")
    _, raw, routing, _ = run(rows, columns, camera, heads, with_dist)
    assert all(((r.chosen >= 0) & (r.chosen < 3)).all() for r in routing.values())
    whole = ~torch.isin(rows, broken)
    assert raw[~whole].isnan().all() and raw[whole].isfinite().all()
    compare(raw[whole], good_raw[whole].double(), 1e-6)


@pytest.mark.usefixtures("triton")
def test_without_gradients():
    rows, columns, camera, heads, with_dist = problem(A=20)
    with torch.no_grad():
        gaussians, raw, _ = call(rows, *moved(columns, heads)[:1], camera, moved(columns, heads)[1], with_dist)
    assert not gaussians.means.requires_grad and not raw.requires_grad


@pytest.mark.usefixtures("triton")
def test_the_tf32_forms_are_a_choice(monkeypatch):
    monkeypatch.setattr(triton_networks, "PRECISION", "tf32x3")  # the interpreter accepts it and computes in float32
    data = problem(A=20)
    exact = oracle(*data)[0]
    compare(run(*data)[0].colors, exact.colors, 1e-4, "colors")


def test_what_does_not_fit_is_refused_or_left_to_torch():
    rows, columns, camera, heads, with_dist = problem(A=4)
    columns, heads = single_precision(columns, heads)
    c = [columns[n] for n in ("xyz", "feature", "log_scaling", "offsets")]
    with pytest.raises(ValueError, match=naming("color", 16, 11)):
        triton_decode.decode(rows, *c, camera.float(), heads, with_dist | {"color": True})
    with pytest.raises(ValueError, match=naming("cov", 3, 4)):
        triton_decode.decode(rows, *c, camera.float(), heads | {"cov": replace(heads["cov"], k=4)}, with_dist)
    deep = replace(heads["cov"], middle_w=torch.zeros(3, 1, 16, 16), middle_b=torch.zeros(3, 1, 16))
    with pytest.raises(ValueError, match=naming("cov", 3)):
        triton_decode.decode(rows, *c, camera.float(), heads | {"cov": deep}, with_dist)
    with pytest.raises(ValueError, match=naming("cov", 11, 8)):
        triton_decode.decode(rows, *c, camera.float(), heads | {"cov": replace(heads["cov"], position=True)}, with_dist)


def scene(config: Anchors, n: int) -> AnchorScene:
    torch.manual_seed(0)
    params = {"feature": torch.randn(n, config.F), "offsets": torch.randn(n, config.K, 3), "log_scaling": 0.3 * torch.randn(n, 6) - 2}
    return AnchorScene(config, Table(params, {"xyz": torch.randn(n, 3), "cell": torch.zeros(n, 3, dtype=torch.int64)}), 0.01, 5.0)


CAMERA = Camera(torch.tensor([[1.0, 0, 0, 0.1], [0, 1, 0, 0.2], [0, 0, 1, 6], [0, 0, 0, 1]]), torch.eye(3), 64, 48)
SCENES = {
    "scaffold": Anchors(decoder=Plain()),
    "top-2": Anchors(decoder=Experts(warmup=0)),
    "dense": Anchors(decoder=Experts(top_k=None)),
    "positions": Anchors(decoder=Experts(warmup=0, router=Linear(input_pos=True))),
}


@pytest.mark.usefixtures("triton")
@pytest.mark.parametrize("name", SCENES)
def test_a_scene_s_two_decodes_agree(name, monkeypatch):
    monkeypatch.setattr(native_decode, "decode", decode_by_triton)  # what a scene on CUDA calls, here for one in the interpreter
    monkeypatch.setattr(anchors, "no_kernels", lambda device: None)
    made = scene(SCENES[name], 50).to(DEVICE)
    camera, rows = CAMERA.to(DEVICE), torch.arange(0, 50, 2, device=DEVICE)
    results = []
    for form in ("native", "composed"):
        made.config = replace(made.config, decode=form)
        made.zero_grad(set_to_none=True)
        d = made.decode(rows, camera, 5)
        values = [*(getattr(d.gaussians, n) for n in PARTS), d.raw_opacity, *(r.gates for r in d.routing.values())]
        torch.manual_seed(1)
        sum((v * torch.randn(v.shape).to(v)).sum() for v in values).backward()
        gradients = {f"{g} {i}": p.grad for g, ps in made.rate_groups().items() for i, p in enumerate(ps)}
        results.append((values, gradients))
    for ours, exact in zip(results[0][0], results[1][0]):
        compare(ours.cpu(), exact.cpu().double(), 2e-6)
    for which, gradient in results[1][1].items():
        if gradient is not None:
            compare(results[0][1][which].cpu(), gradient.cpu().double(), 2e-5, which)


@pytest.mark.gpu
def test_on_cuda_a_scene_decodes_with_triton(triton):
    made = scene(SCENES["top-2"], 50_000).to("cuda")
    rows, camera = torch.arange(0, 50_000, 2, device="cuda"), CAMERA.to("cuda")
    assert explain_missing() is None and made.fused_weights(5) is not None
    ours, exact = made.decode(rows, camera, 5), made.decode_composed(rows, camera, 5)
    agree = torch.isin(ours.gaussians.source, exact.gaussians.source)
    assert agree.float().mean() > 0.9999  # except where rounding changes the sign of an opacity or the order of two logits
    assert (ours.raw_opacity - exact.raw_opacity).abs().mean() < 1e-5


@pytest.mark.gpu
def test_on_cuda_the_host_waits_once(triton):
    made = scene(SCENES["top-2"], 20_000).to("cuda")
    rows, camera = torch.arange(20_000, device="cuda"), CAMERA.to("cuda")
    made.decode(rows, camera, 5).gaussians.means.sum().backward()  # compiled, and memory taken
    torch.cuda.set_sync_debug_mode("warn")
    try:
        with pytest.warns(UserWarning) as caught:
            d = made.decode(rows, camera, 5)
            d.gaussians.means.sum().backward()
    finally:
        torch.cuda.set_sync_debug_mode("default")
    assert sum("synchroniz" in str(w.message) for w in caught) == 1


@pytest.mark.usefixtures("triton")
@pytest.mark.parametrize("case", [{"E": 5, "k": 2}, {"E": 3, "k": (2, 0, None)}, {"E": 4, "k": 1}, {"E": 7, "k": 2}])
def test_routing_of_the_whole_table_draws_a_part_of_it_as_decode_does(case):
    rows, columns, camera, heads, with_dist = problem(A=37, N=90, **case)
    columns, heads = moved(columns, heads)
    kept = triton_decode.Routes(columns["xyz"], [columns[n] for n in ("feature", "log_scaling", "offsets")], heads, with_dist, EXTENT)
    with torch.no_grad():
        expected, expected_raw, _ = call(rows, columns, camera, heads, with_dist)
        found, raw = kept.decode(rows.to(DEVICE), camera.float().to(DEVICE), heads)
    assert torch.equal(raw, expected_raw)
    assert all(torch.equal(getattr(found, n), getattr(expected, n)) for n in (*PARTS, "source"))
