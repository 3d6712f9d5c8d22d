"""What all Triton kernels need: whether they can run, and a launch on the device of their
tensors."""

from __future__ import annotations

import functools
import importlib
import sys
from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from operator import attrgetter, or_
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
    """Launch a kernel on the device of its first tensor. Tensors come before numbers. `sizes` are
    the compile-time constants and options.

    The compiled kernel is kept and launched with addresses, by the same call that Triton's own
    launch ends with. That takes a sixth of the time of Triton's, which binds the arguments anew.
    """
    if not _is_compiled(kernel):  # Triton's interpreter
        with guard(arguments[0].device):
            kernel[grid](*arguments, **sizes)
        return
    count, special = _shape_of(kernel, arguments)
    tensors, numbers = arguments[:count], arguments[count:]
    addresses = [*map(_address, tensors)]
    device = tensors[0].get_device()
    key = (kernel, device, *map(_dtype, tensors), *map(type, numbers), *map(numbers.__getitem__, special), *sizes.values())
    if functools.reduce(or_, addresses) & 15:
        key += (tuple(address & 15 for address in addresses),)
    for number in numbers:
        if number.__class__ is int and not -(2**31) <= number < 2**31:
            key += ("wide", *(-(2**31) <= n < 2**31 for n in numbers))
            break
    kept = _kept.get(key)
    with _NOTHING if torch.cuda.current_device() == device else torch.cuda.device(device):
        if kept is None:
            made = kernel[grid](*arguments, **sizes)
            constants = [sizes[name] for name in kernel.arg_names if name in sizes]
            _kept[key] = made.run, made.function, made.packed_metadata, constants
            return
        run, function, metadata, constants = kept
        sides = (*grid, 1, 1)[:3]
        run(*sides, _stream_of(device), function, metadata, None, None, None, *addresses, *numbers, *constants)


_address, _dtype = Tensor.data_ptr, attrgetter("dtype")
_NOTHING: AbstractContextManager[Any] = nullcontext()


def _stream_of(device: int) -> int:
    """The address of the current stream, by the call that Triton makes."""
    return torch._C._cuda_getCurrentRawStream(device)  # pyright: ignore[reportAttributeAccessIssue]


_kept: dict[tuple[Any, ...], tuple[Callable[..., Any], Any, Any, list[Any]]] = {}
"""Compiled kernels by all that Triton compiles them for."""


@functools.cache
def _is_compiled(kernel: Any) -> bool:
    return hasattr(kernel, "device_caches")


def _shape_of(kernel: Any, arguments: tuple[Any, ...]) -> tuple[int, tuple[int, ...]]:
    """Return how many tensors begin the arguments of a kernel, and which of the numbers after them
    it is compiled for."""
    known = _shapes.get(kernel)
    if known is None:
        count = sum(isinstance(a, Tensor) for a in arguments)
        if not all(isinstance(a, Tensor) for a in arguments[:count]):
            raise TypeError("expected tensors before numbers, found a tensor after a number")
        named = kernel.params[count : len(arguments)]
        special = tuple(i for i, (p, a) in enumerate(zip(named, arguments[count:])) if isinstance(a, int) and not p.do_not_specialize)
        known = _shapes[kernel] = count, special
    return known


_shapes: dict[Any, tuple[int, tuple[int, ...]]] = {}
