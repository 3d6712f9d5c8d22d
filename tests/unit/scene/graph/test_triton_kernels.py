"""A kernel in numbers that one can check by hand, and all compiled for a GPU (none is needed). More results: test_fused.py."""

import pytest
import torch

from scene_experts.native import triton
from support.interpret import DEVICE, compile_for_gpu, kernels

MODULE = "scene_experts.scene.graph.triton_kernels"
NUMBERS = {"A": "i32", "M": "i32", **dict.fromkeys(("low_x", "low_y", "low_z", "edge", "scale", "share"), "fp32")}
INDICES = {**dict.fromkeys(("points", "levels", "sums", "rows", "start", "known", "index", "keep", "source"), "*i64"), "place": "*i32"}
SIZES = {"L": 16, "C": 2, "CP": 2, "F": 32, "FP": 32, "K": 10}


def test_minima_of_three_points_in_a_row_of_which_two_are_seen():
    kernel = kernels(MODULE).neighbour_minima
    feature = torch.tensor([[3.0], [1.0]], device=DEVICE)
    rows, place = torch.tensor([0, 2], device=DEVICE), torch.tensor([0, -1, 1], dtype=torch.int32, device=DEVICE)
    start, known = torch.tensor([0, 2, 3, 6], device=DEVICE), torch.tensor([0, 4, 2, 1, 3, 5], device=DEVICE)  # k = 2: edge e is of e // 2
    least = torch.full((2, 1), 9.0, device=DEVICE)
    triton.launch(kernel, (1,), feature, rows, place, start, known, least, 2, K=2, F=1, B=16, FP=16)
    assert least.tolist() == [[1.0], [1.0]]  # of points 0 and 2; of 0, the unseen 1, and 2


@pytest.mark.slow
@pytest.mark.parametrize("target", [80, 90])
def test_they_compile(target):
    kernel = kernels(MODULE)
    folded = {"H": 64, "IN": 100, "OUT": 68, "WIDTH": 96, "HB": 32}
    encoded = SIZES | {"VIEW": True, "WIDTH": 68}
    blocks = dict.fromkeys(("grid_forward", "grid_backward", "place_points", "place_points_backward"), 128) | {"grid_gradient": 1024}
    names = (*blocks, "neighbour_minima", "blend_forward", "minima_backward", "blend_backward", "fold_forward", "fold_backward")
    for name in names:
        sizes = (SIZES | folded | {"CP": 128} if name.startswith("fold") else encoded) | {"B": blocks.get(name, 16)}
        types = {p: (NUMBERS | INDICES).get(p, "*fp32") for p in getattr(kernel, name).arg_names}
        compile_for_gpu(MODULE, name, types, sizes, target)
