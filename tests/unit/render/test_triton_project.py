"""The kernel compiles for a GPU (none is needed). Its results: test_project_cuda.py."""

import pytest

from support.interpret import compile_for_gpu

SIZES = {"BLUR": 0.3, "B": 256}
TYPES = {"out": "*i32", "extents": "*i32", "M": "i32", "means": "*fp32", "quats": "*fp32", "scales": "*fp32", "view": "*fp32"}


@pytest.mark.slow
@pytest.mark.parametrize("target", [80, 90])
def test_it_compiles(target):
    kernel = ("scene_experts.render.triton_project", "radii")
    compile_for_gpu(*kernel, TYPES, SIZES | {"ROTATED": True, "MASKED": True}, target)
    compile_for_gpu(*kernel, TYPES, SIZES | {"ROTATED": False, "MASKED": False}, target)
