import pytest
import torch

from scene_experts.core.transfer import upload


def test_on_the_cpu_it_is_a_conversion():
    picture = torch.arange(6, dtype=torch.uint8)
    assert upload(picture) is picture and upload(picture, "cpu") is picture
    assert torch.equal(upload(picture, "cpu", torch.float32), picture.float())
    grown = torch.ones(2, requires_grad=True)
    assert upload(grown, "cpu", torch.float64).requires_grad


@pytest.mark.gpu
def test_on_cuda_the_host_does_not_wait():
    picture = torch.randint(0, 256, (400, 300, 3), dtype=torch.uint8)
    upload(picture, "cuda")  # the context
    torch.cuda.set_sync_debug_mode("error")
    try:
        found = upload(picture.transpose(0, 1), "cuda", torch.float32)
    finally:
        torch.cuda.set_sync_debug_mode("default")
    assert torch.equal(found.cpu(), picture.transpose(0, 1).float())
