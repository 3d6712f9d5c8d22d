"""L1 and SSIM against their formulas: slow float64 loops, finite differences, and the compiled form against torch."""

import math

import pytest
import torch
from torchmetrics.functional.image import structural_similarity_index_measure

from scene_experts.native import library as native
from scene_experts.training.photometric import l1, photometric, ssim

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
    parts = (0.7 * l1(exact, y.double()), 0.3 * (1 - ssim(exact, y.double())))
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
    (0.8 * l1(exact, y.double()) + 0.2 * (1 - ssim(exact, y.double()))).backward()
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
    assert float(l1(empty, empty)) == 0.0


@pytest.mark.parametrize("image, target", [((60, 60, 3), (2, 2, 3)), ((8, 8, 4), (8, 8, 4)), ((8, 8), (8, 8)), ((3, 8, 8), (3, 8, 8))])
def test_pictures_of_other_shapes_are_refused(image, target):
    with pytest.raises(ValueError, match="one shape"):
        photometric(torch.zeros(image), torch.zeros(target), 0.2)
