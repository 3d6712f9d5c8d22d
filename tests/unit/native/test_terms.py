"""Native sums against the plain expressions: values to rounding, gradients to the bit."""

import pytest
import torch
from torch.nn import functional

from scene_experts.native import library as native
from scene_experts.native import terms as native_terms

pytestmark = pytest.mark.skipif(native.load() is None, reason="no compiled library")


@pytest.mark.parametrize("count", [0, 1, 20_003])
@pytest.mark.parametrize("threads", [1, 2])
def test_volume(count, threads):
    scales = torch.rand(count, 3, generator=torch.Generator().manual_seed(0)).requires_grad_()
    before = torch.get_num_threads()
    torch.set_num_threads(threads)
    value = 0.01 * (native_terms.sum_volumes(scales) / max(count, 1))
    value.backward()
    torch.set_num_threads(before)
    plain = scales.detach().clone().requires_grad_()
    x, y, z = plain.unbind(1)
    (0.01 * ((x * y * z).sum() / max(count, 1))).backward()
    assert torch.equal(scales.grad, plain.grad)
    exact = 0.01 * plain.detach().double().prod(1).sum() / max(count, 1)
    assert float(value.detach()) == pytest.approx(float(exact), rel=1e-6)


@pytest.mark.parametrize("shape", [(0, 10), (1, 1), (3001, 10)])
@pytest.mark.parametrize("tau", [0.0, 0.3])
def test_hinge(shape, tau):
    raw = torch.randn(shape, generator=torch.Generator().manual_seed(1))
    raw.view(-1)[:1] = tau  # on the corner: no gradient
    raw.requires_grad_()
    value = 0.7 * (native_terms.sum_hinge(raw, tau) / max(raw.numel(), 1))
    value.backward()
    plain = raw.detach().clone().requires_grad_()
    (0.7 * (functional.relu(tau - plain).sum() / max(raw.numel(), 1))).backward()
    assert torch.equal(raw.grad, plain.grad) and torch.equal(raw.grad.signbit(), plain.grad.signbit())
    exact = 0.7 * (tau - plain.detach().double()).clamp_min(0).sum() / max(raw.numel(), 1)
    assert float(value.detach()) == pytest.approx(float(exact), rel=1e-6)


def test_other_dtypes_are_not_covered():
    assert native_terms.covers(torch.zeros(1)) and not native_terms.covers(torch.zeros(1, dtype=torch.float64))
