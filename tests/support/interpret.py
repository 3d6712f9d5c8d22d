"""Run tests of the Triton kernels on the GPU if there is one, otherwise in Triton's interpreter on the CPU."""

import importlib
import os

import pytest
import torch

DEVICE = "cuda" if torch.cuda.is_available() else "cpu"


def kernels(module: str = "scene_experts.scene.anchors.triton_kernels"):
    """Import the kernels of a module for DEVICE. Skips the test if triton is not installed (`make test` does not need it)."""
    if DEVICE == "cpu":
        os.environ["TRITON_INTERPRET"] = "1"  # read when a kernel is defined
    pytest.importorskip("triton", reason="triton is not installed")
    return importlib.import_module(module)
