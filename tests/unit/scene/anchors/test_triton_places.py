"""The numbers of drawn slots. test_triton_decode.py has the rest of these kernels."""

import pytest
import torch

from support.interpret import DEVICE, compile_for_gpu, kernels

MODULE = "scene_experts.scene.anchors.triton_places"


def test_drawn_slots_are_numbered_in_order():
    raw = torch.tensor([0.5, -1.0, 0.0, float("nan"), 2.0, 1e-9, -0.0], device=DEVICE)
    counted = (raw > 0).cumsum(0, dtype=torch.int32)
    dst = torch.empty(7, dtype=torch.int32, device=DEVICE)
    kernels(MODULE).number[(2,)](raw, counted, dst, 7, B=4)
    assert dst.tolist() == [0, -1, -1, -1, 1, 2, -1]


@pytest.mark.slow
@pytest.mark.parametrize("target", [80, 90])
def test_it_compiles(target):
    compile_for_gpu(MODULE, "number", {"raw": "*fp32", "counted": "*i32", "dst": "*i32", "count": "i32"}, {"B": 1024}, target)
