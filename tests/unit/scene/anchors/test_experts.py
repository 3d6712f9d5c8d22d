"""The mixture of experts against the paper's equations, anchor by anchor."""

import pytest
import torch
from torch.nn import functional

from scene_experts.core.errors import InputError
from scene_experts.core.types import Mode
from scene_experts.scene.anchors.experts import Experts, MixtureHead, Router, top_k
from scene_experts.scene.anchors.mlp import MLP, Plain

A, F, D, H, OUT = 50, 32, 35, 32, 30
SPARSE = 1501  # the first Top-k iteration


def head(attribute="color", **config) -> MixtureHead:
    torch.manual_seed(1)
    built = Experts(**config).build(attribute, D, H, OUT, F)
    assert isinstance(built, MixtureHead)
    return built.double()


def data():
    torch.manual_seed(2)
    return torch.randn(A, D, dtype=torch.float64), torch.randn(A, F, dtype=torch.float64)


def oracle(h: MixtureHead, x, f, k):
    """eq. 3 - 5, anchor by anchor."""
    activation = {"color": torch.sigmoid, "opacity": torch.tanh, "cov": lambda y: y}[h.attribute]
    rows = []
    for a in range(len(x)):
        gates = torch.softmax(h.router_w @ f[a] + (h.router_b if h.router_b is not None else 0), 0)
        chosen = list(range(len(gates))) if k is None else sorted(range(len(gates)), key=lambda i: (-float(gates[i].detach()), i))[:k]
        total = sum(gates[i] for i in chosen)
        y = 0
        for i in chosen:
            hidden = functional.relu(h.w1[i] @ x[a] + h.b1[i])
            y = y + gates[i] / total * activation(h.w2[i] @ hidden + h.b2[i])
        rows.append(y)
    return torch.stack(rows)


@pytest.mark.parametrize("attribute", ["opacity", "cov", "color"])
@pytest.mark.parametrize(("step", "k"), [(1500, None), (1501, 2)])
def test_dense_then_top_k_as_the_paper_writes_them(attribute, step, k):
    h = head(attribute)
    x, f = data()
    y, routing = h(x, f, step)
    torch.testing.assert_close(y, oracle(h, x, f, k))
    torch.testing.assert_close(routing.gates.sum(1), torch.ones(A, dtype=torch.float64))
    assert (routing.chosen is None) == (k is None)


@pytest.mark.parametrize("k", [1, 2, 3, 5])
def test_gathered_form_equals_masked_form_in_value_and_gradient(k):
    x, f = data()
    found = []
    for form in ("fast", "masked"):
        h = head(top_k=k, form=form)
        x_, f_ = x.clone().requires_grad_(), f.clone().requires_grad_()
        y, _ = h(x_, f_, SPARSE)
        y.square().sum().backward()
        found.append([y.detach(), x_.grad, f_.grad] + [torch.zeros_like(p) if p.grad is None else p.grad for p in h.parameters()])
    for fast, masked in zip(*found):
        torch.testing.assert_close(fast, masked, rtol=1e-9, atol=1e-10)


def test_all_experts_chosen_equals_dense_in_value_and_gradient():
    h, found = head(top_k=5), []
    for step in (SPARSE, 1):
        h.zero_grad()
        x, f = (part.clone().requires_grad_() for part in data())
        y, _ = h(x, f, step)
        y.square().sum().backward()
        found.append([y.detach(), x.grad, f.grad, *(p.grad for p in h.parameters())])
    for sparse, dense in zip(*found):
        torch.testing.assert_close(sparse, dense, rtol=1e-9, atol=1e-10)


def test_dense_for_good():
    assert head(top_k=None)(*data(), 30_000)[1].chosen is None


def test_zero_features_route_all_alike_and_give_the_router_no_weight_gradient():
    h = head()
    x, _ = data()
    f = torch.zeros(A, F, dtype=torch.float64)
    y, routing = h(x, f, SPARSE)
    y.sum().backward()
    assert (routing.chosen == routing.chosen[0]).all()
    assert not h.router_w.grad.any() and h.router_b.grad.any()


@pytest.mark.parametrize(("renormalise", "trained"), [(True, False), (False, True)])
def test_top_1_with_renormalised_weight_leaves_the_router_untrained(renormalise, trained):
    h = head(top_k=1, router=Router(renormalise=renormalise))
    y, _ = h(*data(), SPARSE)
    y.sum().backward()
    largest = 0.0 if h.router_w.grad is None else float(h.router_w.grad.abs().max())
    assert (largest > 1e-3) == trained and (trained or largest < 1e-9)


def test_ties_go_to_the_lowest_index():
    assert top_k(torch.zeros(3, 5), 2).tolist() == [[0, 1]] * 3
    assert top_k(torch.tensor([[0.0, 2.0, 1.0, 2.0]]), 3).tolist() == [[1, 3, 2]]


def test_one_expert_is_the_plain_network_bit_for_bit():
    torch.manual_seed(7)
    one = Experts(num=1, top_k=1).build("cov", D, H, 70, F)
    torch.manual_seed(7)
    plain = Plain().build("cov", D, H, 70, F)
    x, f = (t.float() for t in data())
    assert isinstance(one, MLP) and torch.equal(one(x, f, 1)[0], plain(x, f, 1)[0])


def test_parameter_counts():
    count = lambda attribute, out, inputs, config: sum(p.numel() for p in config.build(attribute, inputs, 32, out, 32).parameters())  # noqa: E731
    shapes = [("opacity", 10), ("cov", 70), ("color", 30)]
    assert [count(a, o, 35, Plain()) for a, o in shapes] == [1482, 3462, 2142]
    assert [count(a, o, 36, Plain()) for a, o in shapes] == [1514, 3494, 2174]
    assert sum(count(a, o, 35, Experts()) for a, o in shapes) == 35_925
    assert sum(count(a, o, 36, Experts()) for a, o in shapes) == 36_405


def test_switches():
    x, f = data()
    pre = head(mix="pre_activation")
    assert not torch.allclose(pre(x, f, SPARSE)[0], head()(x, f, SPARSE)[0])
    assert pre.weights(SPARSE).linear and head().weights(SPARSE).k == 2 and head().weights(1).k is None
    assert head(shared=True).weights(SPARSE).k == 3 and head(shared=True, router=Router(weights="margin")).weights(SPARSE) is None
    assert head(router=Router(bias=False)).router_b is None
    assert not head(router=Router(init="zeros")).router_w.any()
    jitter = head(expert_init="clone_jitter")
    torch.testing.assert_close(jitter.w1[1], jitter.w1[0], rtol=0.1, atol=0.01)
    detached = head(router=Router(detach_feature=True))
    f_ = f.clone().requires_grad_()
    detached(x, f_, SPARSE)[0].sum().backward()
    assert f_.grad is None
    positioned = head(router=Router(input_pos=True))
    assert positioned.router_w.shape == (5, F + 3)
    with pytest.raises(ValueError, match="input_pos"):
        positioned(x, f, SPARSE)
    positioned(x, f, SPARSE, torch.zeros(A, 3, dtype=torch.float64))
    noisy = head(router=Router(noise_std=1.0))
    assert not torch.equal(noisy(x, f, SPARSE, mode=Mode.TRAIN)[0], noisy(x, f, SPARSE, mode=Mode.TRAIN)[0])
    assert torch.equal(noisy(x, f, SPARSE)[0], noisy(x, f, SPARSE)[0])


def test_aligned_quaternions_do_not_cancel():
    h = head("cov", num=2, top_k=None)
    h = MixtureHead(h.config, "cov", D, H, 70, F).double()
    with torch.no_grad():
        for p in (h.w1, h.b1, h.w2, h.router_w, h.router_b):
            p.zero_()
        h.b2[0], h.b2[1] = 1.0, -1.0
    x, f = data()
    y, _ = h.aligned(x, f, 1, None, 10)
    assert y.reshape(A, 10, 7)[..., 3:].abs().min() == 1.0  # (1 + 1) / 2 after the flip
    assert h(x, f, 1)[0].abs().max() == 0.0  # they cancel without it


def test_top_1_warns(caplog):
    Experts(top_k=1).build("opacity", D, H, 10, F)
    assert [record.levelname for record in caplog.records] == ["WARNING"]


def test_nonsense_is_refused():
    for wrong, said in (
        (Experts(num=2, top_k=3), r"--scene\.decoder\.top-k"),
        (Experts(top_k=0), r"--scene\.decoder\.top-k"),
        (Experts(num=0), r"--scene\.decoder\.num"),
        (Experts(warmup=-1), r"--scene\.decoder\.warmup"),
    ):
        with pytest.raises(InputError, match=said):
            wrong.check()  # before a capture is read
        with pytest.raises(InputError, match=said):
            wrong.build("color", D, H, OUT, F)


def test_with_distance_the_three_plain_networks_sum_to_7182():
    shapes = [("opacity", 10), ("cov", 70), ("color", 30)]
    assert sum(p.numel() for a, o in shapes for p in Plain().build(a, 36, 32, o, 32).parameters()) == 7182


def test_experts_of_one_network_s_variance():
    torch.manual_seed(0)
    x, f = torch.randn(400, D), torch.randn(400, F)
    spread = {}
    for init in ("independent", "variance"):
        made = []
        for _ in range(20):
            h = Experts(expert_init=init, router=Router(init="zeros")).build("cov", D, H, 70, F)
            made.append(h(x, f, 1)[0].detach())
        spread[init] = float(torch.stack(made).var())
    one = float(torch.stack([MLP("cov", D, H, 70)(x, f, 1)[0].detach() for _ in range(20)]).var())
    assert spread["variance"] == pytest.approx(one, rel=0.1)
    assert spread["independent"] == pytest.approx(one / 5, rel=0.1)


@pytest.mark.parametrize("k", [1, 2, 4])
def test_margin_weights_as_written(k):
    h = head(top_k=k, router=Router(weights="margin"))
    f = data()[1]
    routing, w = h.route(f, SPARSE, None)
    for a in range(A):
        g = sorted(routing.gates[a].tolist(), reverse=True)
        margins = [value - g[k] + 1e-4 for value in g[:k]]
        torch.testing.assert_close(w[a], torch.tensor([m / sum(margins) for m in margins], dtype=w.dtype))
    assert h.weights(SPARSE).margin


def test_margin_weights_have_no_jump():
    """Where two experts swap ranks at the edge of Top-k, the outputs on both sides agree; with softmax weights they do not."""
    jump = {}
    for weights in ("softmax", "margin"):
        h = head(top_k=2, router=Router(weights=weights))
        x, f = data()
        w, b = torch.zeros(5, F, dtype=torch.float64), torch.tensor([3.0, 1.0, 1.0, -1.0, -1.0], dtype=torch.float64)
        w[1, 0], w[2, 0] = 1.0, -1.0
        h.router_w.data, h.router_b.data = w, b
        sides = []
        for shift in (1e-7, -1e-7):
            f = f.clone()
            f[:, 0] = shift
            sides.append(h(x, f, SPARSE)[0])
        jump[weights] = float((sides[0] - sides[1]).detach().abs().max())
    assert jump["margin"] < 1e-4 < 1e-3 < jump["softmax"]


@pytest.mark.parametrize("weights", ["softmax", "margin"])
@pytest.mark.parametrize("form", ["fast", "masked"])
@pytest.mark.parametrize("step", [1, SPARSE])
def test_a_shared_expert_decodes_every_anchor(weights, form, step):
    h = head(top_k=2, shared=True, form=form, router=Router(weights=weights))
    x, f = data()
    y, routing = h(x, f, step)
    assert routing.gates.shape == (A, 5) and len(h.w1) == 6 and h.experts == 5
    logits = f @ h.router_w.T + h.router_b
    every = [h.expert(i, x) for i in range(6)]
    for a in range(A):
        if step == 1:
            shares = dict(enumerate(torch.softmax(logits[a], 0)))
        else:
            assert 5 not in routing.chosen[a]
            chosen = routing.chosen[a].tolist()
            if weights == "softmax":
                shares = dict(zip([*chosen, 5], torch.softmax(logits[a, [*chosen, 5]], 0)))
            else:
                g = torch.softmax(logits[a, :5], 0)
                margins = g[chosen] - g.sort(descending=True).values[2] + 1e-4
                part = torch.sigmoid(logits[a, 5])
                shares = {**dict(zip(chosen, (1 - part) * margins / margins.sum())), 5: part}
        torch.testing.assert_close(y[a], sum(share * every[i][a] for i, share in shares.items()))


def test_gradients_of_margin_weights_and_the_shared_expert():
    h = head(top_k=2, shared=True, router=Router(weights="margin"))
    x, f = data()
    f = f[:4].requires_grad_()
    assert torch.autograd.gradcheck(lambda feature: h(x[:4], feature, SPARSE)[0], (f,), eps=1e-7, atol=1e-5)
