"""The kernel that shows whether Triton works on this machine."""

import torch

from scene_experts.native import triton
from support.interpret import DEVICE, kernels


def test_it_writes_a_one():
    to = torch.zeros(1, device=DEVICE)
    triton.launch(kernels("scene_experts.native.triton_probe").probe, (1,), to)
    assert to.item() == 1
