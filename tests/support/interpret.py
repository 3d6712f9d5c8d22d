"""Run tests of the Triton kernels on the GPU if there is one, otherwise in Triton's interpreter on the CPU."""

import os

import pytest
import torch

DEVICE = "cuda" if torch.cuda.is_available() else "cpu"


def kernels():
    """Import the kernels for DEVICE. Skips the test if triton is not installed (`make test` does not need it)."""
    if DEVICE == "cpu":
        os.environ["TRITON_INTERPRET"] = "1"  # read when a kernel is defined
    pytest.importorskip("triton", reason="triton is not installed")
    from scene_experts.scene.anchors import triton_kernels

    return triton_kernels
