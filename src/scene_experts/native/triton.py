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
    for t in tensors:
        if not t.is_cuda or t.dtype != torch.float32:
            return False
    return explain_missing() is None


def guard(device: torch.device) -> AbstractContextManager[Any]:
    """Context manager in which `device` is the current CUDA device. Triton launches on the current
    device, not on that of the tensors."""
    return torch.cuda.device(device) if device.type == "cuda" else nullcontext()


def launch(kernel: Any, grid: tuple[int, ...], *arguments: Any, **sizes: Any) -> None:
    """Launch a kernel once, see `Launch`."""
    find_launch(kernel, **sizes)(grid, *arguments)


def find_launch(kernel: Any, **sizes: Any) -> Launch:
    """Return the launch of a kernel with these constants and options, made once."""
    key = (id(kernel), *sizes.items())
    known = _launches.get(key)
    if known is None:
        known = _launches[key] = Launch(kernel, **sizes)
    return known


class Launch:
    """A kernel with its compile-time constants and options, to be launched on the device of its
    first tensor. Tensors come before numbers.

    A compiled kernel is kept and launched with addresses, by the same call that Triton's own launch
    ends with. That takes a sixth of the time of Triton's, which binds the arguments anew.
    """

    def __init__(self, kernel: Any, **sizes: Any) -> None:
        self.kernel, self.sizes = kernel, sizes
        self.compiled = hasattr(kernel, "device_caches")  # not in Triton's interpreter
        self.count = -1  # of the tensors that begin the arguments
        self.special: tuple[int, ...] = ()  # numbers after them that the kernel is compiled for
        self.ints: tuple[int, ...] = ()
        self.kept: dict[Any, tuple[Callable[..., Any], Any, Any, list[Any]]] = {}
        self.last: tuple[Any, Any] = None, None  # key and value of the last launch

    def __call__(self, grid: tuple[int, ...], *arguments: Any) -> None:
        if not self.compiled:
            with guard(arguments[0].device):
                self.kernel[grid](*arguments, **self.sizes)
            return
        if self.count < 0:
            self._learn(arguments)
        tensors, numbers = arguments[: self.count], arguments[self.count :]
        addresses = [*map(_address, tensors)]
        device = tensors[0].get_device()
        key = (device, *map(_dtype, tensors), *map(type, numbers), *map(numbers.__getitem__, self.special))
        if functools.reduce(or_, addresses) & 15:
            key += (tuple(address & 15 for address in addresses),)
        for i in self.ints:
            if not -(2**31) <= numbers[i] < 2**31:
                key += ("wide", *(-(2**31) <= numbers[i] < 2**31 for i in self.ints))
                break
        last, kept = self.last
        if key != last:  # quicker than a look into the dictionary, which hashes it
            kept = self.kept.get(key)
            self.last = key, kept
        with _NOTHING if torch.cuda.current_device() == device else torch.cuda.device(device):
            if kept is None:
                made = self.kernel[grid](*arguments, **self.sizes)
                constants = [self.sizes[name] for name in self.kernel.arg_names if name in self.sizes]
                self.kept[key] = kept = made.run, made.function, made.packed_metadata, constants
                self.last = key, kept
                return
            run, function, metadata, constants = kept
            run(*(*grid, 1, 1)[:3], _stream_of(device), function, metadata, None, None, None, *addresses, *numbers, *constants)

    def _learn(self, arguments: tuple[Any, ...]) -> None:
        self.count = sum(isinstance(a, Tensor) for a in arguments)
        if not all(isinstance(a, Tensor) for a in arguments[: self.count]):
            raise TypeError("expected tensors before numbers, found a tensor after a number")
        numbers = arguments[self.count :]
        self.ints = tuple(i for i, a in enumerate(numbers) if isinstance(a, int))
        named = self.kernel.params[self.count : len(arguments)]
        self.special = tuple(i for i in self.ints if not named[i].do_not_specialize)


_address, _dtype = Tensor.data_ptr, attrgetter("dtype")
_NOTHING: AbstractContextManager[Any] = nullcontext()


def _stream_of(device: int) -> int:
    """The address of the current stream, by the call that Triton makes."""
    return torch._C._cuda_getCurrentRawStream(device)  # pyright: ignore[reportAttributeAccessIssue]


_launches: dict[tuple[Any, ...], Launch] = {}
