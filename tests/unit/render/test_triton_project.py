"""The kernel in numbers that one can check by hand, and compiled for a GPU (none is needed). More results: test_project_cuda.py."""

import math

import pytest
import torch

from scene_experts.native import triton
from support.interpret import DEVICE, compile_for_gpu, kernels

SIZES = {"BLUR": 0.3, "B": 256}
TYPES = {"out": "*i32", "extents": "*i32", "M": "i32", "means": "*fp32", "quats": "*fp32", "scales": "*fp32", "view": "*fp32"}


def test_a_ball_on_the_axis():
    kernel = kernels("scene_experts.render.triton_project").radii
    means, scales = torch.tensor([[0.0, 0, 4], [0, 0, 0.1]], device=DEVICE), torch.full((2, 3), 0.2, device=DEVICE)
    out = torch.full((2,), 9, dtype=torch.int32, device=DEVICE)
    tensors = (means, means, scales, torch.eye(4, device=DEVICE), out, out)
    near, limits = 0.2, (-1.0, 1.0, -1.0, 1.0)
    triton.launch(kernel, (1,), *tensors, 2, near, 100.0, 100.0, 32.0, 32.0, *limits, 64.0, 64.0, **SIZES, ROTATED=False, MASKED=False)
    variance = (100 * 0.2 / 4) ** 2 + 0.3  # px^2; the second one is too near
    assert out.tolist() == [math.ceil(3 * math.sqrt(variance + math.sqrt(0.1))), 0]


@pytest.mark.slow
@pytest.mark.parametrize("target", [80, 90])
def test_it_compiles(target):
    kernel = ("scene_experts.render.triton_project", "radii")
    compile_for_gpu(*kernel, TYPES, SIZES | {"ROTATED": True, "MASKED": True}, target)
    compile_for_gpu(*kernel, TYPES, SIZES | {"ROTATED": False, "MASKED": False}, target)
