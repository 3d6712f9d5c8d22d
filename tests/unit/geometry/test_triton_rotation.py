"""Unit quaternions and their gradients against torch in float64."""

import pytest
import torch
from torch.nn import functional

from support.interpret import DEVICE, kernels

triton_rotation = kernels("scene_experts.geometry.triton_rotation")  # skips this file where triton is not installed
import triton  # noqa: E402
import triton.language as tl  # noqa: E402


@triton.jit
def both(q, unit, d_unit, d_q, count, B: tl.constexpr):
    at = tl.arange(0, B)
    triton_rotation.write_unit(q + at * 4, unit + at * 4, at < count)
    tl.debug_barrier()
    triton_rotation.write_unit_backward(q + at * 4, unit + at * 4, d_unit + at * 4, d_q + at * 4, at < count)


@pytest.mark.parametrize("count", [1, 13])
def test_value_and_gradient(count):
    exact = torch.randn(count, 4, dtype=torch.float64, generator=torch.Generator().manual_seed(count))
    exact[0] = 0.0  # has no direction
    exact.requires_grad_()
    up = torch.randn(count, 4, dtype=torch.float64, generator=torch.Generator().manual_seed(7))
    expected = functional.normalize(exact, dim=-1)
    expected.backward(up)
    q, d_unit = exact.detach().float().to(DEVICE), up.float().to(DEVICE)
    unit, d_q = torch.full((16, 4), 7.0, device=DEVICE), torch.full((16, 4), 7.0, device=DEVICE)
    both[(1,)](q, unit, d_unit, d_q, count, B=16)
    torch.testing.assert_close(unit[:count].cpu().double(), expected.detach(), rtol=1e-6, atol=1e-7)
    torch.testing.assert_close(d_q[1:count].cpu().double(), exact.grad[1:], rtol=1e-5, atol=1e-6)
    torch.testing.assert_close(d_q[0].cpu().double(), exact.grad[0], rtol=1e-5, atol=0.0)
    assert (unit[count:] == 7).all() and (d_q[count:] == 7).all()
