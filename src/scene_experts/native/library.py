"""Load the compiled library built for this processor (sources in csrc/), or explain why there is
none.

`scene_experts/_native` holds one shared library per instruction set; `load` takes the best one that
this processor runs and binds it to the interface of `api.py`. Of the package this module imports
only two modules of `core`, so every layer may use it.
"""

from __future__ import annotations

import ctypes
import functools
import os
import sys
from pathlib import Path

import torch
from torch import Tensor

from scene_experts.core.errors import InputError, RunError
from scene_experts.core.version import package_folders
from scene_experts.native import api

LEVELS = ("avx512", "avx2", "portable")  # best first
_SUFFIX = {"win32": ".dll", "darwin": ".dylib"}.get(sys.platform, ".so")


class Library(ctypes.CDLL):
    """The compiled library, with the functions of `api.FUNCTIONS`."""

    level: str
    """Instruction set that it was built for, one of `LEVELS`."""


def list_levels() -> tuple[str, ...]:
    """The instruction sets that this processor runs, best first."""
    capability = torch.backends.cpu.get_cpu_capability()
    best = "avx512" if capability.startswith("AVX512") else "avx2" if capability.startswith("AVX2") else "portable"
    return LEVELS[LEVELS.index(best) :]


def find(level: str) -> Path | None:
    """The path of the installed library for `level`, or None."""
    for folder in package_folders():
        candidate = folder / "_native" / f"se_{level}{_SUFFIX}"
        if candidate.is_file():
            return candidate
    return None


@functools.cache
def load(level: str | None = None) -> Library | None:
    """Load and bind the library for `level` (None: the best for this processor).

    Returns None if no library is installed, or if it is damaged, has another interface
    (`api.ABI_VERSION`) or needs instructions that this processor lacks.
    """
    for name in (name for name in list_levels() if level in (None, name)):
        path = find(name)
        if path is None:
            continue
        try:
            library = Library(str(path))
            if library.se_abi_version() != api.ABI_VERSION:
                continue
            api.bind(library)
        except (OSError, AttributeError):  # damaged, or built for another system
            continue
        library.level = name
        return library
    return None


def require(level: str | None = None) -> Library:
    """The library for `level` (None: the best for this processor). Raises InputError if `load`
    returns None."""
    library = load(level)
    if library is None:
        raise InputError(
            explain_missing()
            or f"the compiled CPU library for {level} is not there or does not run here: choose one of {', '.join(list_levels())}"
        )
    return library


def check(code: int, work: str) -> None:
    """Raise RunError if `code`, returned by a function of the library, says that `work` ran out of
    memory."""
    if code:
        raise RunError(f"{work} ran out of memory: use fewer Gaussians (--max-anchors, --max-memory) or smaller pictures (--resolution)")


def explain_missing() -> str | None:
    """None if a library loads, else one sentence that says why not and what to do."""
    if load() is not None:
        return None
    found = [name for name in LEVELS if find(name)]
    if not found:
        return "the compiled CPU library is not installed: install a C++20 compiler (g++ or clang++) and run `pip install .` again"
    return f"the compiled CPU library ({', '.join(found)}) does not fit this machine or this version: run `pip install .` again"


def pointer(tensor: Tensor | None) -> ctypes.c_void_p:
    """The address of a contiguous CPU tensor's first element (None: a null pointer)."""
    if tensor is None:
        return ctypes.c_void_p(0)
    assert tensor.device.type == "cpu" and tensor.is_contiguous()
    return ctypes.c_void_p(tensor.data_ptr())


def count_cores() -> int:
    """Number of cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def count_threads() -> int:
    """Number of threads that native code may use: torch's setting."""
    return torch.get_num_threads()
