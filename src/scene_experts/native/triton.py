"""What all Triton kernels need: whether they can run, and a launch on the device of their
tensors."""

from __future__ import annotations

import functools
import importlib
import sys
from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from typing import Any

import torch
from torch import Tensor


@functools.cache
def explain_missing() -> str | None:
    """Return None if Triton kernels can run, otherwise one sentence with the reason and the remedy.

    Without a CUDA device, only the import is checked.
    """
    if torch.version.hip is not None:
        return "the Triton kernels are for NVIDIA GPUs, and this torch is for AMD's ROCm: plain torch runs instead"
    try:
        importlib.import_module("triton")
    except Exception as error:  # a broken installation can raise any exception
        reason = str(error).strip().splitlines()[-1:] or [type(error).__name__]
        fix = "`pip install triton-windows`, its port" if sys.platform == "win32" else "`pip install triton`"
        return f"triton cannot be imported ({reason[0]}): install it with {fix}; plain torch runs instead"
    if not torch.cuda.is_available():
        return None
    if torch.cuda.get_device_capability()[0] < 8:
        return "the Triton kernels need a GPU of compute capability 8.0 or newer: plain torch runs instead"
    try:  # Triton builds its launcher with the system's C compiler
        probe = importlib.import_module("scene_experts.native.triton_probe").probe
        launch(probe, (1,), torch.zeros(1, device="cuda"))
    except Exception as error:
        reason = str(error).strip().splitlines()[-1:] or [type(error).__name__]
        return f"triton cannot compile here ({reason[0]}): install a C compiler; plain torch runs instead"
    return None


def covers(*tensors: Tensor) -> bool:
    """Whether the tensors are float32 on CUDA and Triton kernels can run."""
    return all(t.device.type == "cuda" and t.dtype == torch.float32 for t in tensors) and explain_missing() is None


def guard(device: torch.device) -> AbstractContextManager[Any]:
    """Context manager in which `device` is the current CUDA device. Triton launches on the current
    device, not on that of the tensors."""
    return torch.cuda.device(device) if device.type == "cuda" else nullcontext()


def launch(kernel: Any, grid: tuple[int, ...], *arguments: Any, **sizes: Any) -> None:
    """Launch a kernel on the device of its first tensor. `sizes` are the compile-time constants."""
    first = next(a for a in arguments if isinstance(a, Tensor))
    run: Callable[..., Any] = kernel[grid]
    with guard(first.device):
        run(*arguments, **sizes)
