"""The Triton form of L1 and SSIM against the plain torch form in float64."""

import pytest
import torch

from scene_experts.training import photometric as module
from scene_experts.training.photometric import _PhotometricCuda, photometric
from support.interpret import DEVICE, compile_for_gpu, kernels


@pytest.fixture(scope="module", autouse=True)
def _triton():
    kernels("scene_experts.training.triton_loss")


def pair(height, width, near=False):
    torch.manual_seed(height)
    target = torch.rand(height, width, 3)
    return (target + 0.01 * torch.randn_like(target)).clamp(0, 1) if near else torch.rand(height, width, 3), target


@pytest.mark.parametrize(("size", "near"), [((1, 1), False), ((50, 70), False), ((44, 45), True), ((7, 90), True)])
def test_values_and_gradient(size, near):
    image, target = pair(*size, near=near)
    exact = image.double().requires_grad_()
    expected = photometric(exact, target.double(), 0.2)
    (expected[0] + 3 * expected[1]).backward()
    ours = image.to(DEVICE).requires_grad_()
    found = _PhotometricCuda.apply(ours, target.to(DEVICE), 0.2)
    (found[0] + 3 * found[1]).backward()
    for a, b in zip(found, expected):
        torch.testing.assert_close(a.detach().cpu().double(), b.detach(), rtol=2e-6, atol=1e-8)
    error = (ours.grad.cpu().double() - exact.grad).norm() / exact.grad.norm()
    assert error < 5e-6


def test_equal_images_and_no_gradient():
    image, _ = pair(20, 30)
    with torch.no_grad():
        terms = _PhotometricCuda.apply(image.to(DEVICE), image.to(DEVICE), 0.2)
    assert float(terms[0]) == float(terms[1]) == 0
    ours = image.to(DEVICE).requires_grad_()
    sum(_PhotometricCuda.apply(ours, image.to(DEVICE), 0.2)).backward()
    assert not ours.grad.any()


def test_a_tile_s_size_does_not_matter(monkeypatch):
    image, target = (t.to(DEVICE) for t in pair(40, 33))
    with torch.no_grad():
        small = _PhotometricCuda.apply(image, target, 0.5)
        monkeypatch.setattr(module, "TILE", 64)
        large = _PhotometricCuda.apply(image, target, 0.5)
    torch.testing.assert_close(large, small, rtol=1e-6, atol=0)


@pytest.mark.slow
@pytest.mark.parametrize("target", [80, 90])
def test_the_kernels_compile(target):
    images = dict.fromkeys(("image", "target", "gradient", "sums", "by_l1", "by_dssim", "out"), "*fp32")
    types, sizes = images | {"H": "i32", "W": "i32", "count": "i32"}, {"R": 5, "SCALE": 0.2, "NORM": 3.76, "C1": 1e-4, "C2": 9e-4}
    sizes |= {"T": module.TILE, "WANTED": True, "PRECISION": module.PRECISION}
    for both in (True, False):
        constants = sizes | {"BOTH": both}
        found = compile_for_gpu("scene_experts.training.triton_loss", "forward", types, constants, target, num_warps=module.WARPS)
        assert found.local == 0, found
    compile_for_gpu("scene_experts.training.triton_loss", "backward", types, {"B": 1024}, target)
