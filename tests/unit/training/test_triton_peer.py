"""The Triton kernels of the CUDA benchmarks' peer compute what those of the project do."""

import pytest
import torch

from peer_cuda import adam, loss
from scene_experts.training.photometric import photometric
from support.interpret import DEVICE, kernels


@pytest.fixture(scope="module", autouse=True)
def _triton():
    kernels("peer_cuda.kernels")


def pair(height, width):
    torch.manual_seed(height)
    target = torch.rand(height, width, 3)
    return (target + 0.05 * torch.randn_like(target)).clamp(0, 1), target


def test_its_kernels_of_the_loss():
    image, target = pair(50, 47)
    exact = image.double().requires_grad_()
    expected = photometric(exact, target.double(), 0.2)
    (expected[0] + 3 * expected[1]).backward()
    ours = image.to(DEVICE).requires_grad_()
    found = loss.Photometric.apply(ours, target.to(DEVICE), 0.2)
    (found[0] + 3 * found[1]).backward()
    torch.testing.assert_close(torch.stack(found).detach().cpu().double(), torch.stack(expected).detach(), rtol=3e-6, atol=1e-8)
    assert (ours.grad.cpu().double() - exact.grad).norm() < 5e-6 * exact.grad.norm()


def test_its_kernel_of_adam(monkeypatch):
    monkeypatch.setattr(adam, "BLOCK", 64)
    made = []
    for form in (True, False):
        torch.manual_seed(0)
        values = [torch.nn.Parameter(torch.randn(shape, device=DEVICE)) for shape in ((40, 5), (7, 3, 3), ())]
        made.append(adam.Adam([{"params": [p], "lr": 0.01} for p in values], eps=1e-8))
        made[-1]._triton = form
        for step in range(3):
            torch.manual_seed(step)
            for p in values:
                p.grad = torch.randn(p.shape, device=DEVICE)
            made[-1].step()
    for ours, exact in zip(*(optimizer.param_groups for optimizer in made)):  # its 1 - beta is formed in float32
        torch.testing.assert_close(ours["params"][0], exact["params"][0], rtol=1e-5, atol=1e-6)
