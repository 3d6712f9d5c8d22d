"""The mixture of experts against the paper's equations, anchor by anchor."""

import pytest
import torch
from torch.nn import functional

from scene_experts.core.errors import InputError
from scene_experts.core.fields import check_fields
from scene_experts.scene.anchors.experts import Experts, Mixture
from scene_experts.scene.anchors.mlp import MLP, Plain

A, F, D, H, OUT = 50, 32, 35, 32, 30
SPARSE = 1501  # the first Top-k iteration


def head(attribute="color", **config) -> Mixture:
    torch.manual_seed(1)
    built = Experts(**config).build(attribute, D, H, OUT, F)
    assert isinstance(built, Mixture)
    return built.double()


def data():
    torch.manual_seed(2)
    return torch.randn(A, D, dtype=torch.float64), torch.randn(A, F, dtype=torch.float64)


def oracle(h: Mixture, x, f, k):
    """eq. 3 - 5, anchor by anchor."""
    activation = {"color": torch.sigmoid, "opacity": torch.tanh, "cov": lambda y: y}[h.networks.attribute]
    router, own, rows = h.router, h.networks, []
    for a in range(len(x)):
        gates = torch.softmax(router.w @ f[a] + router.b, 0)
        chosen = list(range(len(gates))) if k is None else sorted(range(len(gates)), key=lambda i: (-float(gates[i].detach()), i))[:k]
        total = sum(gates[i] for i in chosen)
        y = 0
        for i in chosen:
            hidden = functional.relu(own.w1[i] @ x[a] + own.b1[i])
            y = y + gates[i] / total * activation(own.w2[i] @ hidden + own.b2[i])
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
    """Computing each expert for the anchors that chose it is the same as computing all and zeroing the weights of the others."""
    found = []
    for masked in (False, True):
        h = head(top_k=k)
        x, f = (part.clone().requires_grad_() for part in data())
        routing, w = h.route(f, SPARSE)
        if masked:
            y = h.networks.all(x, w.new_zeros(A, 5).scatter(1, routing.chosen, w))
        else:
            y = h(x, f, SPARSE)[0]
        y.square().sum().backward()
        found.append([y.detach(), x.grad, f.grad] + [torch.zeros_like(p) if p.grad is None else p.grad for p in h.parameters()])
    for gathered, zeroed in zip(*found):
        torch.testing.assert_close(gathered, zeroed, rtol=1e-9, atol=1e-10)


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
    assert not h.router.w.grad.any() and h.router.b.grad.any()


def test_top_1_with_renormalised_weight_leaves_the_router_untrained():
    h = head(top_k=1)
    y, _ = h(*data(), SPARSE)
    y.sum().backward()
    assert h.router.w.grad is None or float(h.router.w.grad.abs().max()) < 1e-9


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


def test_kernels_get_the_phase_of_the_curriculum():
    assert head().weights(SPARSE).k == 2 and head().weights(1).k is None
    jitter = head(expert_init="clone_jitter").networks
    torch.testing.assert_close(jitter.w1[1], jitter.w1[0], rtol=0.1, atol=0.01)


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
            check_fields(wrong, "scene.decoder")  # before a capture is read


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
            h = Experts(expert_init=init).build("cov", D, H, 70, F)
            for p in h.router.parameters():
                torch.nn.init.zeros_(p)
            made.append(h(x, f, 1)[0].detach())
        spread[init] = float(torch.stack(made).var())
    one = float(torch.stack([MLP("cov", D, H, 70)(x, f, 1)[0].detach() for _ in range(20)]).var())
    assert spread["variance"] == pytest.approx(one, rel=0.1)
    assert spread["independent"] == pytest.approx(one / 5, rel=0.1)
