"""The losses against their formulas: slow float64 loops, finite differences, the paper's limits, and the compiled form against torch."""

import math
from dataclasses import replace

import pytest
import torch
from torchmetrics.functional.image import structural_similarity_index_measure

from scene_experts.core.types import Decoded, Gaussians, Render, Routing
from scene_experts.native import library as native
from scene_experts.training import losses
from scene_experts.training.losses import Weights, load_dense, load_sparse, opacity_hinge, photometric, ssim, terms, volume

SIZES = [(7, 5), (1, 1), (17, 33), (64, 48), (101, 130)]


def pictures(H, W, dtype=torch.float64, seed=0):
    generator = torch.Generator().manual_seed(seed)
    x = torch.rand(H, W, 3, generator=generator, dtype=dtype)
    y = (x + 0.2 * torch.randn(H, W, 3, generator=generator, dtype=dtype)).clamp(0, 1)
    return x, y


def ssim_by_loops(x, y):
    """SSIM pixel by pixel: the 11 x 11 window, zero outside."""
    H, W, _ = x.shape
    line = [math.exp(-(t**2) / (2 * 1.5**2)) for t in range(-5, 6)]
    total = sum(line) ** 2
    sums = 0.0
    x, y = x.tolist(), y.tolist()
    for c in range(3):
        for i in range(H):
            for j in range(W):
                mx = my = xx = yy = xy = 0.0
                for a in range(max(0, i - 5), min(H, i + 6)):
                    for b in range(max(0, j - 5), min(W, j + 6)):
                        w = line[a - i + 5] * line[b - j + 5] / total
                        u, v = x[a][b][c], y[a][b][c]
                        mx, my, xx, yy, xy = mx + w * u, my + w * v, xx + w * u * u, yy + w * v * v, xy + w * u * v
                one = (2 * mx * my + 1e-4) / (mx * mx + my * my + 1e-4)
                sums += one * (2 * (xy - mx * my) + 9e-4) / (xx - mx * mx + yy - my * my + 9e-4)
    return sums / (3 * H * W)


@pytest.mark.parametrize(("H", "W"), [(1, 1), (7, 5), (13, 9)])
def test_ssim_is_the_windowed_formula(H, W):
    x, y = pictures(H, W)
    assert float(ssim(x, y)) == pytest.approx(ssim_by_loops(x, y), abs=1e-12)


def test_ssim_agrees_with_torchmetrics():
    # It pads by reflection; within a frame of 6 black pixels that is our zero padding.
    x, y = (torch.nn.functional.pad(v, [0, 0, 6, 6, 6, 6]) for v in pictures(40, 48))
    reference = structural_similarity_index_measure(x.permute(2, 0, 1)[None], y.permute(2, 0, 1)[None], data_range=1.0)
    ours = ssim(x, y)
    assert float(ours) == pytest.approx(float(reference), abs=1e-9)  # type: ignore[arg-type]


@pytest.mark.parametrize("size", SIZES)
def test_the_compiled_form_equals_torch_in_value_and_gradient(size):
    if native.load() is None:
        pytest.skip("no compiled library")
    x, y = pictures(*size, dtype=torch.float32)
    exact = x.double().requires_grad_()
    parts = (0.7 * losses.l1(exact, y.double()), 0.3 * (1 - ssim(exact, y.double())))
    for scale in ((1.0, 1.0), (2.0, 2.0), (3.0, 0.5)):
        (expected,) = torch.autograd.grad(scale[0] * parts[0] + scale[1] * parts[1], exact, retain_graph=True)
        fast = x.clone().requires_grad_()
        found = photometric(fast, y, 0.3)
        (scale[0] * found[0] + scale[1] * found[1]).backward()
        assert abs(float((found[0] - parts[0]).detach())) < 1e-6 and abs(float((found[1] - parts[1]).detach())) < 1e-6
        assert float((fast.grad - expected).norm() / expected.norm()) < 2e-6


@pytest.mark.parametrize("level", native.list_levels())
@pytest.mark.parametrize("threads", [1, 2])
def test_every_build_gives_the_same_and_threads_change_nothing(level, threads, monkeypatch):
    library = native.load(level)
    if library is None:
        pytest.skip(f"no {level} build")
    monkeypatch.setattr(native, "load", lambda level=None: library)
    monkeypatch.setattr(native, "count_threads", lambda: threads)
    x, y = pictures(150, 67, dtype=torch.float32)
    fast, exact = x.clone().requires_grad_(), x.double().requires_grad_()
    found = photometric(fast, y, 0.2)
    sum(found).backward()
    (0.8 * losses.l1(exact, y.double()) + 0.2 * (1 - ssim(exact, y.double()))).backward()
    torch.testing.assert_close(fast.grad.double(), exact.grad, rtol=1e-4, atol=1e-10)
    monkeypatch.setattr(native, "count_threads", lambda: 1)
    again = x.clone().requires_grad_()
    sum(photometric(again, y, 0.2)).backward()
    assert torch.equal(again.grad, fast.grad)


def test_flat_and_equal_pictures():
    flat = torch.full((20, 30, 3), 0.9)
    for value in photometric(flat.clone().requires_grad_(), flat, 0.2):
        assert float(value.detach()) == 0.0
    black = torch.zeros(20, 30, 3, requires_grad=True)
    sum(photometric(black, torch.zeros(20, 30, 3), 0.2)).backward()
    assert torch.isfinite(black.grad).all() and black.grad.abs().max() < 1e-6


def test_finite_differences_in_float64():
    x, y = pictures(9, 7)
    mask = (torch.rand(9, 7, generator=torch.Generator().manual_seed(3)) > 0.3).double()
    for m in (None, mask):
        assert torch.autograd.gradcheck(lambda v: sum(photometric(v, y, 0.3, m)), (x.requires_grad_(),), eps=1e-6, atol=1e-7)  # noqa: B023


def test_a_mask_leaves_out_what_it_covers():
    x, y = pictures(30, 40, dtype=torch.float32)
    mask = torch.zeros(30, 40)
    mask[5:25, 8:30] = 1
    spoiled = x.clone()
    spoiled[mask == 0] = 7.0
    picture = spoiled.requires_grad_()
    found = photometric(picture, y, 0.2, mask)
    sum(found).backward()
    assert float(found[0].detach()) == pytest.approx(0.8 * float((x - y).abs()[5:25, 8:30].mean()), rel=1e-5)
    assert not picture.grad[mask == 0].any() and picture.grad[mask == 1].any()
    torch.testing.assert_close(sum(photometric(x, y, 0.2, torch.ones(30, 40))), sum(photometric(x, y, 0.2)))
    nothing = photometric(x, y, 0.2, torch.zeros(30, 40, dtype=torch.bool))
    assert [float(v) for v in nothing] == [0.0, 0.0]


def test_a_picture_without_pixels_costs_nothing():
    empty = torch.zeros(0, 5, 3)
    assert float(losses.l1(empty, empty)) == 0.0


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


def test_the_switches_of_the_load_balance():
    sparse, dense = Routing(*routed(5, 2, True)), Routing(routed(3, 2, True)[0], None)
    s, d = float(load_sparse(sparse.gates, sparse.chosen)), float(load_dense(dense.gates))
    both = s + float(load_dense(sparse.gates))
    value = lambda **w: float(terms(*scene({"color": sparse, "cov": dense}), Weights(load=0.5, **w))["load"])  # noqa: E731
    assert value() == pytest.approx(0.5 * (s + d))
    assert value(load_reduce="mean") == pytest.approx(0.25 * (s + d))
    assert value(load_phase="both") == pytest.approx(0.5 * (both + d))
    assert value(load_normalise_by_k=True) == pytest.approx(0.5 * (s / 2 + d))


def test_the_window_of_the_opacity_hinge():
    w = Weights(opacity=0.1, opacity_from=10, opacity_until=20)
    on = [step for step in (9, 10, 20, 21) if "opacity" in terms(*scene(), w, step)]
    assert on == [10, 20] and "opacity" in terms(*scene(), w)


def test_hinge_scopes():
    raw = torch.tensor([[-1.0, 0.5], [-0.5, -0.5], [0.1, 0.2]])
    g = Gaussians(torch.zeros(3, 3), torch.zeros(3, 4), torch.zeros(3, 3), torch.zeros(3), torch.zeros(3, 3), torch.tensor([9, 14, 15]))
    radii = torch.tensor([3, 0, 2], dtype=torch.int32)
    render = Render(torch.zeros(4, 4, 3), torch.zeros(4, 4), torch.zeros(4, 4), radii, torch.zeros(3, 2))
    decoded = Decoded(g, torch.tensor([4, 6, 7]), raw, {}, scene_opacity=torch.full((8, 2), -0.25))
    value = lambda scope: float(terms(decoded, render, torch.zeros(4, 4, 3), Weights(opacity=1.0, opacity_scope=scope))["opacity"])  # noqa: E731
    assert value("visible") == pytest.approx(2.0 / 6)
    assert value("rendered_anchors") == pytest.approx(1.0 / 4)  # anchors 4 and 7 have a slot with radius > 0
    assert value("all") == pytest.approx(0.25)


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
