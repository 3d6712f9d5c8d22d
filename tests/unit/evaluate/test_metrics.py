"""Scores against their formulas, with and without masks."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor

from scene_experts.evaluate import metrics, weights
from scene_experts.evaluate.lpips import Lpips
from scene_experts.evaluate.metrics import Perceptual
from scene_experts.training import photometric
from support.lpips import random_tensors


def pair(height: int = 40, width: int = 50, seed: int = 0) -> tuple[Tensor, Tensor]:
    gen = torch.Generator().manual_seed(seed)
    target = torch.rand(height, width, 3, generator=gen)
    return (target + 0.1 * torch.randn(height, width, 3, generator=gen)).clamp(0, 1), target


def half(height: int = 40, width: int = 50) -> Tensor:
    mask = torch.zeros(height, width)
    mask[:, : width // 2] = 1
    return mask


def test_psnr() -> None:
    target = torch.zeros(4, 5, 3)
    assert metrics.psnr(target + 0.1, target) == pytest.approx(20.0)
    one = target.clone()
    one[0, 0, 0] = 0.5
    assert metrics.psnr(one, target) == pytest.approx(20 * math.log10(1 / math.sqrt(0.25 / 60)))
    assert metrics.psnr(target, target) == 100.0


def test_psnr_counts_only_unmasked_pixels() -> None:
    image, target = pair()
    assert metrics.psnr(image, target, half()) == pytest.approx(metrics.psnr(image[:, :25], target[:, :25]))
    spoiled = image.clone()
    spoiled[:, 25:] = 0
    assert metrics.psnr(spoiled, target, half()) == metrics.psnr(image, target, half())


def test_ssim_is_that_of_the_losses() -> None:
    image, target = pair()
    assert metrics.ssim(image, target) == pytest.approx(float(photometric.ssim(image, target)))
    assert metrics.ssim(target, target) == pytest.approx(1.0)


def test_masked_ssim_equals_that_of_the_counted_part() -> None:
    """A uniform error has the same score with half of it masked, except for windows across the edge of the mask."""
    image, target = pair(80, 240)
    whole, masked = metrics.ssim(image, target), metrics.ssim(image, target, half(80, 240))
    assert abs(masked - whole) < 0.1 * (1 - whole)
    spoiled = image.clone()
    spoiled[:, 120:] = 0
    assert metrics.ssim(spoiled, target, half(80, 240)) == pytest.approx(masked)
    assert metrics.ssim(image, target, torch.ones(80, 240)) == pytest.approx(whole, abs=1e-6)


def test_sharpness() -> None:
    ramp = torch.linspace(0, 1, 11)[None, :, None].expand(7, 11, 3)
    assert metrics.sharpness(ramp) == pytest.approx(0.1)
    assert metrics.sharpness(ramp.transpose(0, 1)) == pytest.approx(0.1)
    checks = ((torch.arange(40)[:, None] + torch.arange(50)) % 2).float()[..., None].expand(-1, -1, 3)
    assert metrics.sharpness(checks) == pytest.approx(math.sqrt(2))
    blurred = (checks[1:, 1:] + checks[:-1, 1:] + checks[1:, :-1] + checks[:-1, :-1]) / 4
    assert metrics.sharpness(blurred) < 1e-6
    both = torch.cat([checks, torch.zeros(40, 50, 3)], dim=1)
    mask = torch.cat([torch.ones(40, 50), torch.zeros(40, 50)], dim=1)
    assert metrics.sharpness(both, mask) == pytest.approx(math.sqrt(2))


def test_detail_is_the_share_of_the_photographs_gradient() -> None:
    gray = torch.rand(9, 12, generator=torch.Generator().manual_seed(0))
    target = gray[..., None].expand(-1, -1, 3)
    assert metrics.detail(target, target) == pytest.approx(1)
    assert metrics.detail(0.3 * target + 0.2, target) == pytest.approx(0.3)
    assert metrics.detail(1 - target, target) == pytest.approx(-1)
    assert metrics.detail(torch.zeros_like(target), target) == 0 and metrics.detail(target, torch.zeros_like(target)) is None
    dx, dy = np.diff(gray.numpy(), axis=1)[:-1], np.diff(gray.numpy(), axis=0)[:, :-1]
    other = torch.rand(9, 12, 3, generator=torch.Generator().manual_seed(1))
    mean = other.mean(2).numpy()
    projected = (np.diff(mean, axis=1)[:-1] * dx + np.diff(mean, axis=0)[:, :-1] * dy)[:, :5].sum()
    mask = (torch.arange(12) < 6).float().expand(9, -1)  # differences of five columns
    assert metrics.detail(other, target, mask) == pytest.approx(projected / (dx[:, :5] ** 2 + dy[:, :5] ** 2).sum(), rel=1e-5)


def test_specks_do_not_raise_the_detail() -> None:
    target = torch.linspace(0, 1, 64)[None, :, None].expand(48, 64, 3)
    specks = target + 0.2 * (torch.rand(48, 64, 1, generator=torch.Generator().manual_seed(2)) > 0.9)
    assert metrics.sharpness(specks) > 2 * metrics.sharpness(target)
    assert metrics.detail(specks, target) == pytest.approx(1, abs=0.2)


def test_each_variant_gets_its_own_input() -> None:
    networks = {net: Lpips(net, random_tensors(net)) for net in ("vgg", "alex")}
    image, target = pair()
    found = Perceptual(networks)(image, target)
    assert found["lpips"] == networks["vgg"](2 * image - 1, 2 * target - 1)
    assert found["lpips_3dgs"] == networks["vgg"](image, target)
    assert found["lpips_alex"] == networks["alex"](2 * image - 1, 2 * target - 1)
    assert found.keys() == metrics.NETWORKS.keys() < metrics.VARIANTS.keys()


def test_without_weights_the_reason_is_reported(monkeypatch: pytest.MonkeyPatch) -> None:
    def load(net: str, explicit: Path | None = None) -> tuple[dict[str, Tensor], str]:
        if net == "vgg":
            raise weights.MissingWeights("no weights of LPIPS (vgg): run this")
        return random_tensors(net), "somewhere"

    monkeypatch.setattr(weights, "load", load)
    found = Perceptual.find()
    assert found.absent == dict.fromkeys(("lpips", "lpips_3dgs"), "no weights of LPIPS (vgg): run this")
    assert found.sources == {"alex": "somewhere"} and set(found(*pair())) == {"lpips_alex"}
    assert set(Perceptual.off().absent) == {"lpips", "lpips_3dgs", "lpips_alex"}


def test_only_missing_weights_are_downloaded(monkeypatch: pytest.MonkeyPatch) -> None:
    fetched: list[str] = []

    def load(net: str, explicit: Path | None = None) -> tuple[dict[str, Tensor], str]:
        if net == "alex" and not fetched:  # also where a damaged file is there
            raise weights.MissingWeights("found a wrong checksum")
        return random_tensors(net), "here"

    monkeypatch.setattr(weights, "download", lambda net, progress=None: fetched.append(net))
    monkeypatch.setattr(weights, "load", load)
    assert not Perceptual.find(fetch=True).absent and fetched == ["alex"]


def test_pictures_too_small_for_a_network() -> None:
    perceptual = Perceptual({net: Lpips(net, random_tensors(net)) for net in ("vgg", "alex")})
    found = perceptual(*pair(20, 20))
    assert set(found) == {"lpips", "lpips_3dgs"} and "31" in perceptual.absent["lpips_alex"]


@pytest.mark.gpu
def test_scores_on_cuda_are_those_on_the_cpu() -> None:
    networks = {net: Lpips(net, random_tensors(net)) for net in ("vgg", "alex")}
    image, target = pair(64, 80)
    here = metrics.score(image, target, None, Perceptual(networks))
    there = metrics.score(image.cuda(), target.cuda(), None, Perceptual({net: network.to("cuda") for net, network in networks.items()}))
    assert there == pytest.approx(here, rel=1e-4)
    assert torch.backends.cudnn.allow_tf32  # unchanged


def test_pictures_of_one_pixel_have_finite_scores():
    for shape in ((1, 1, 3), (1, 5, 3), (5, 1, 3)):
        found = metrics.score(torch.rand(shape), torch.rand(shape), None, metrics.Perceptual.off())
    assert found.pop("detail") is None and all(math.isfinite(value) for value in found.values())
