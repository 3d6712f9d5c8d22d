"""Where the tests of the Triton kernels run: on the GPU where there is one, else in Triton's interpreter on the CPU."""

import os

import pytest
import torch

DEVICE = "cuda" if torch.cuda.is_available() else "cpu"


def kernels():
    """The module of kernels, made for DEVICE. Skips the test where triton is not installed (it is no part of `make test`)."""
    if DEVICE == "cpu":
        os.environ["TRITON_INTERPRET"] = "1"  # read when a kernel is defined
    pytest.importorskip("triton", reason="triton is not installed")
    from scene_experts.scene.anchors import triton_kernels

    return triton_kernels
