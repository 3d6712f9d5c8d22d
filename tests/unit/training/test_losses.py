"""The terms of the objective against their formulas and the paper's limits, and a term of another package."""

import math
from dataclasses import dataclass, replace

import pytest
import torch

from scene_experts.core.parts import register
from scene_experts.core.types import Decoded, Gaussians, Render, Routing
from scene_experts.training.losses import Sample, Weights, compute_terms, depth_error, load_dense, load_sparse, opacity_hinge, volume
from scene_experts.training.photometric import ssim


def terms(decoded: Decoded, render: Render, target: torch.Tensor, weights: Weights, step: int | None = None) -> dict[str, torch.Tensor]:
    return compute_terms(Sample(decoded, render, target, step=step), weights)


def pictures(H, W, dtype=torch.float64, seed=0):
    generator = torch.Generator().manual_seed(seed)
    x = torch.rand(H, W, 3, generator=generator, dtype=dtype)
    y = (x + 0.2 * torch.randn(H, W, 3, generator=generator, dtype=dtype)).clamp(0, 1)
    return x, y


def test_volume_and_hinge():
    scales = torch.tensor([[1.0, 2, 3], [2, 2, 0.5]], requires_grad=True)
    volume(scales).backward()
    assert volume(scales).item() == 4.0
    torch.testing.assert_close(scales.grad, torch.tensor([[3.0, 1.5, 1], [0.5, 0.5, 2]]))
    empty = torch.zeros(0, 3, requires_grad=True)
    volume(empty).backward()
    assert volume(empty).item() == 0.0 and empty.grad.shape == (0, 3)
    positive = torch.full((4, 10), 0.3, requires_grad=True)
    opacity_hinge(positive).backward()
    assert opacity_hinge(positive).item() == 0.0 and not positive.grad.any()
    negative = torch.full((4, 10), -0.3, requires_grad=True)
    opacity_hinge(negative).backward()
    assert opacity_hinge(negative).item() == pytest.approx(0.3)
    torch.testing.assert_close(negative.grad, torch.full((4, 10), -1 / 40))
    assert float(opacity_hinge(torch.full((2, 2), 0.1), tau=0.25)) == pytest.approx(0.15)
    nobody = torch.zeros(0, 10, requires_grad=True)
    opacity_hinge(nobody).backward()
    assert opacity_hinge(nobody).item() == 0.0


def routed(E, k, crowded, n=1000):
    """Gates and Top-k sets: perfectly balanced, or 0.98 on expert 0 for all."""
    if crowded:
        gates = torch.full((n, E), 0.02 / (E - 1))
        gates[:, 0] = 0.98
        second = torch.arange(n) % (E - 1) + 1
        return gates, torch.stack([torch.zeros(n, dtype=torch.long), second], 1)[:, :k]
    first = torch.arange(n * E) % E
    chosen = torch.stack([(first + i) % E for i in range(k)], 1)
    return torch.full((n * E, E), 1 / E), chosen


@pytest.mark.parametrize(("E", "k", "crowded"), [(5, 1, 4.90), (5, 2, 4.93), (3, 2, 2.97)])
def test_sparse_balance_is_k_at_best_and_nearly_E_at_worst(E, k, crowded):
    assert float(load_sparse(*routed(E, k, False))) == pytest.approx(k, rel=1e-5)
    assert float(load_sparse(*routed(E, k, True))) == pytest.approx(crowded, abs=0.01)


@pytest.mark.parametrize(("E", "crowded"), [(5, 4.80), (3, 2.88)])
def test_dense_balance_is_1_at_best_and_nearly_E_at_worst(E, crowded):
    assert float(load_dense(routed(E, 1, False)[0])) == pytest.approx(1.0, rel=1e-5)
    assert float(load_dense(routed(E, 1, True)[0])) == pytest.approx(crowded, abs=0.01)


def test_one_hot_gates():
    same, spread = torch.eye(5)[torch.zeros(50, dtype=torch.long)], torch.eye(5)[torch.arange(50) % 5]
    assert float(load_sparse(same, same.argmax(1, keepdim=True))) == pytest.approx(5) and float(load_dense(same)) == pytest.approx(5)
    assert float(load_sparse(spread, spread.argmax(1, keepdim=True))) == pytest.approx(1)
    assert float(load_dense(spread)) == pytest.approx(1)


def test_sparse_balance_pushes_mass_off_crowded_experts_and_through_the_gates_alone():
    gates, chosen = routed(5, 2, True, n=20)
    gates.requires_grad_()
    load_sparse(gates, chosen).backward()
    share = torch.bincount(chosen.reshape(-1), minlength=5) / 20
    torch.testing.assert_close(gates.grad, (5 * share / 20).expand(20, 5))  # E pi_i / |B|
    empty = torch.zeros(0, 5, requires_grad=True)
    value = load_sparse(empty, torch.zeros(0, 2, dtype=torch.long)) + load_dense(empty)
    value.backward()
    assert value.item() == 0.0


def scene(routing=None, M=6, opacity=-0.5):
    g = Gaussians(torch.zeros(M, 3), torch.zeros(M, 4), torch.ones(M, 3), torch.ones(M), torch.ones(M, 3), torch.arange(M))
    decoded = Decoded(g, torch.arange(2), torch.full((2, 3), opacity), routing or {})
    x, y = pictures(12, 15, dtype=torch.float32)
    return decoded, Render(x, x[..., 0], x[..., 0], torch.zeros(M, dtype=torch.int32), torch.zeros(M, 2)), y


def test_terms_are_named_weighted_and_absent_at_weight_zero():
    decoded, render, target = scene()
    found = terms(decoded, render, target, Weights(opacity=0.1, load=0.1))
    assert list(found) == ["l1", "dssim", "volume", "opacity"]  # no experts, no load
    assert float(found["l1"]) == pytest.approx(0.8 * float((render.image - target).abs().mean()), rel=1e-5)
    assert float(found["dssim"]) == pytest.approx(0.2 * (1 - float(ssim(render.image.double(), target.double()))), abs=1e-6)
    assert float(found["volume"]) == pytest.approx(0.01) and float(found["opacity"]) == pytest.approx(0.05)
    assert list(terms(decoded, render, target, Weights(dssim=0.0, scale=0.0))) == ["l1"]


def test_the_load_balance_is_the_sum_over_the_attributes_of_the_phase_s_loss():
    sparse, dense = Routing(*routed(5, 2, True)), Routing(routed(3, 2, True)[0], None)
    s, d = float(load_sparse(sparse.gates, sparse.chosen)), float(load_dense(dense.gates))
    assert float(terms(*scene({"color": sparse, "cov": dense}), Weights(load=0.5))["load"]) == pytest.approx(0.5 * (s + d))


def test_the_hinge_is_over_all_slots_of_the_visible_anchors():
    decoded, render, target = scene()
    raw = torch.tensor([[-1.0, 0.5], [-0.5, -0.5], [0.1, 0.2]])
    found = terms(replace(decoded, raw_opacity=raw), render, target, Weights(opacity=1.0))
    assert float(found["opacity"]) == pytest.approx(2.0 / 6)


def test_the_window_of_the_opacity_hinge():
    w = Weights(opacity=0.1, opacity_from=10, opacity_until=20)
    on = [step for step in (9, 10, 20, 21) if "opacity" in terms(*scene(), w, step)]
    assert on == [10, 20] and "opacity" in terms(*scene(), w)


def test_mean_opacity_and_size_are_over_every_gaussian():
    decoded, render, target = scene()
    w = Weights(scale=0.0, mean_opacity=0.01, mean_size=0.02)
    assert set(terms(decoded, render, target, w)) == {"l1", "dssim"}  # anchors have no population
    logits, log_scales = torch.tensor([0.0, -2.0, 3.0]), torch.randn(3, 3, generator=torch.Generator().manual_seed(0))
    found = terms(replace(decoded, population=(logits, log_scales)), render, target, w)
    assert float(found["mean_opacity"]) == pytest.approx(0.01 * sum(1 / (1 + math.exp(-x)) for x in (0, -2, 3)) / 3)
    assert float(found["mean_size"]) == pytest.approx(0.02 * sum(math.exp(x) for x in log_scales.flatten().tolist()) / 9)
    none = replace(decoded, population=(logits[:0], log_scales[:0]))
    assert float(terms(none, render, target, w)["mean_opacity"]) == 0


@register
@dataclass(frozen=True)
class SmoothWeights(Weights):
    """Weights with a term of another package."""

    smooth: float = 0.5


def smooth_term(w: SmoothWeights, sample: Sample) -> dict[str, torch.Tensor]:
    return {"smooth": w.smooth * sample.render.image.diff(dim=1).abs().mean()} if w.smooth else {}


SmoothWeights.terms = (*Weights.terms, smooth_term)


def test_a_term_comes_from_outside():
    decoded, render, target = scene()
    found = terms(decoded, render, target, SmoothWeights())
    assert list(found) == ["l1", "dssim", "volume", "smooth"]
    assert float(found["smooth"]) == pytest.approx(0.5 * float(render.image.diff(dim=1).abs().mean()))
    assert list(terms(decoded, render, target, SmoothWeights(smooth=0.0))) == list(terms(decoded, render, target, Weights()))


def test_the_error_of_the_depth_is_relative_bounded_and_of_solid_known_pixels():
    drawn = torch.tensor([[1.1, 1.9, 6.0], [3.0, 4.0, 5.0]], dtype=torch.float64, requires_grad=True)
    alpha = torch.tensor([[1.0, 0.95, 1.0], [0.5, 1.0, 1.0]], dtype=torch.float64, requires_grad=True)
    known = torch.tensor([[1.0, 2.0, 3.0], [3.0, 0.0, 4.0]], dtype=torch.float64)  # far off, not solid, not known, masked
    mask = torch.tensor([[1.0, 1, 1], [1, 1, 0]], dtype=torch.float64)
    error = depth_error(drawn, alpha, known, mask)
    error.backward()
    assert error.item() == pytest.approx((0.1 + 0.0 + 0.2) / 6, abs=1e-12) and alpha.grad is None
    assert drawn.grad.flatten().tolist() == pytest.approx([1 / 6, 0, 0, 0, 0, 0]), "what is off by less than a fifth pulls"
    assert depth_error(drawn, alpha, known).item() == pytest.approx((0.1 + 0.2 + 0.2) / 6, abs=1e-12)
    enlarged = depth_error(drawn[:, :2], alpha[:, :2], known[:1, :1])  # a map with fewer pixels
    assert enlarged.item() == pytest.approx((0.1 + 0.2 + 0.2) / 4)
    x = torch.rand(3, 4, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(lambda x: depth_error(1 + 0.1 * x, torch.ones(3, 4).double(), torch.full((3, 4), 1.2).double()), x)


def test_the_weight_of_the_depth_falls_to_a_tenth():
    weights = Weights(depth=0.2, depth_until=100)
    found = [weights.weigh_depth(step) for step in (None, 0, 50, 100, 500)]
    assert found == pytest.approx([0.2, 0.2, 0.2 * 0.1**0.5, 0.02, 0.02])
    x, y = pictures(4, 5)
    render = Render(x, torch.ones(4, 5).double(), torch.full((4, 5), 2.2).double(), torch.zeros(0), torch.zeros(0, 2))
    sample = Sample(None, render, y, step=100, depth=torch.full((4, 5), 2.0).double())
    by_hand = {w: weights.terms[1](replace(weights, depth=w), sample) for w in (0.0, 0.2)}
    assert by_hand[0.0] == {} and float(by_hand[0.2]["depth"]) == pytest.approx(0.02 * 0.1)
    assert weights.terms[1](weights, replace(sample, depth=None)) == {}
