"""Loads the compiled library built for this processor (sources in csrc/), or says why there is none.

One shared library per instruction set is installed in `scene_experts/_native`; the best that this processor runs is taken. Nothing here
imports anything of the project but the errors, so every layer may use it.
"""

from __future__ import annotations

import ctypes
import functools
import os
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

import scene_experts
from scene_experts.core.errors import RunError

ABI_VERSION = 5
LEVELS = ("avx512", "avx2", "portable")  # best first
_SUFFIX = {"win32": ".dll", "darwin": ".dylib"}.get(sys.platform, ".so")


def levels() -> tuple[str, ...]:
    """The instruction sets of this processor that a library may have been built for, best first."""
    capability = torch.backends.cpu.get_cpu_capability()
    best = "avx512" if capability.startswith("AVX512") else "avx2" if capability.startswith("AVX2") else "portable"
    return LEVELS[LEVELS.index(best) :]


def path(level: str) -> Path | None:
    """Where the library for `level` is installed, or None."""
    for root in scene_experts.__path__:
        candidate = Path(root) / "_native" / f"se_{level}{_SUFFIX}"
        if candidate.is_file():
            return candidate
    return None


@functools.cache
def load(level: str | None = None) -> ctypes.CDLL | None:
    """The library for `level` (None: the best of this processor), or None where none is installed, damaged, or of another version."""
    for name in (level,) if level else levels():
        where = path(name)
        if where is None:
            continue
        try:
            library = ctypes.CDLL(str(where))
            version = library.se_abi_version()
        except (OSError, AttributeError):  # damaged, or built for another system
            continue
        if version == ABI_VERSION:
            library.level = name  # type: ignore[attr-defined]
            return library
    return None


def bound(functions: Mapping[str, Sequence[Any]], level: str | None = None) -> ctypes.CDLL | None:
    """The library with the argument types of functions that return nothing; None where `load` gives none."""
    library = load(level)
    for name, types in functions.items() if library else ():
        getattr(library, name).argtypes, getattr(library, name).restype = list(types), None
    return library


def done(code: int, what: str) -> None:
    """Raises RunError where a function of the library returned that memory ran out in `what`."""
    if code:
        raise RunError(f"{what} ran out of memory: use fewer Gaussians (--max-anchors, --max-memory) or smaller pictures (--resolution)")


def why_not() -> str | None:
    """None where a library loads; else one sentence that says why not and what to do."""
    if load() is not None:
        return None
    found = [name for name in LEVELS if path(name)]
    if not found:
        return "the compiled CPU library is not installed: install a C++20 compiler (g++ or clang++) and run `pip install .` again"
    return f"the compiled CPU library ({', '.join(found)}) does not fit this machine or this version: run `pip install .` again"


def pointer(tensor: Tensor | None) -> ctypes.c_void_p:
    """The address of a contiguous CPU tensor's first element (None: a null pointer)."""
    if tensor is None:
        return ctypes.c_void_p(0)
    assert tensor.device.type == "cpu" and tensor.is_contiguous()
    return ctypes.c_void_p(tensor.data_ptr())


def cores() -> int:
    """Cores this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def threads() -> int:
    """How many threads native code may use: torch's own setting."""
    return torch.get_num_threads()
