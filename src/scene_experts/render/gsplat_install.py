"""Whether gsplat can draw on this machine, and if not, why and what to do.

gsplat without a prebuilt wheel compiles its CUDA code when it is first imported, which takes
minutes. A build that has failed is written to the user's cache, so that it is not tried again by
every command: only where the versions or the CUDA toolkit have changed, and by `scene-experts
doctor`.
"""

from __future__ import annotations

import functools
import importlib
import importlib.metadata
import importlib.util
import inspect
import os
import re
import shutil
import sys
from contextlib import suppress
from pathlib import Path

import torch

from scene_experts.core.errors import InputError, RunError
from scene_experts.core.extras import install_line
from scene_experts.core.io import cache_dir, read_json, write_json

FAILED = "Error building extension"  # how torch begins the message of a build that failed
LONGEST = 300  # characters of somebody else's message in ours
ELSE = "or use --device cpu"


@functools.cache
def explain_missing() -> str | None:
    """Return None if gsplat can draw, otherwise a sentence that says why not and what to do. May
    compile gsplat, for minutes."""
    return _explain_machine() or recall_failure() or _try()


def is_likely() -> bool:
    """Whether gsplat can probably draw. Compiles nothing."""
    return _explain_machine() is None and recall_failure() is None and _is_installed()


def try_again() -> None:
    """Forget a build that failed, so that `explain_missing` tries it again."""
    with suppress(OSError):
        _place().unlink(missing_ok=True)
    explain_missing.cache_clear()


def recall_failure() -> str | None:
    """Return the sentence of a build that failed with today's versions and CUDA toolkit, if any."""
    with suppress(InputError, RunError):
        known = read_json(_place(), "remembered build")
        if isinstance(known, dict) and known.get("key") == _key() and isinstance(known.get("why"), str):
            return f"{known['why'][: 3 * LONGEST]} (tried before; `scene-experts doctor` tries again)"
    return None


def _explain_machine() -> str | None:
    """What no installation of gsplat can mend."""
    if torch.version.hip is not None:
        return f"gsplat draws on NVIDIA GPUs, and this torch is built for AMD's ROCm {torch.version.hip}: use the rasteriser cpu"
    if not torch.cuda.is_available():
        return "gsplat needs a CUDA device and a CUDA build of torch, and torch finds none: use the rasteriser cpu"
    return None


def _is_installed() -> bool:
    if "gsplat" in sys.modules:
        return sys.modules["gsplat"] is not None
    return importlib.util.find_spec("gsplat") is not None


def _try() -> str | None:
    """Import gsplat with its CUDA code, and look at what was found."""
    if not _is_installed():
        return f"gsplat, which draws on CUDA, is not installed: {install_line('cuda')}, {ELSE}"
    try:
        module = importlib.import_module("gsplat")
        backend = importlib.import_module("gsplat.cuda._backend")
    except Exception as error:  # a broken CUDA toolkit raises almost any exception while gsplat compiles
        return _explain_failure(error)
    if "opacities" not in inspect.signature(module.fully_fused_projection).parameters:
        found = getattr(module, "__version__", "an older one")
        return f"gsplat 1.5.3 or newer is required, found {found}: run `pip install -U gsplat`"
    if getattr(backend, "_C", module) is None:
        return f"gsplat finds no CUDA toolkit (nvcc) to compile its CUDA code with: {_ask_for_toolkit()}"
    return None


def _explain_failure(error: Exception) -> str:
    text = str(error).strip() or type(error).__name__
    if FAILED not in text:
        return f"gsplat cannot be imported ({_shorten(' '.join(text.split()))}): {install_line('cuda')}, {ELSE}"
    why = f"gsplat is installed, but its CUDA code does not compile here ({find_error_line(text)}): {_ask_for_toolkit()}"
    with suppress(RunError, OSError):
        _place().parent.mkdir(parents=True, exist_ok=True)
        write_json(_place(), {"key": _key(), "why": why})
    return why


def find_error_line(text: str) -> str:
    """Return the first line of a compiler's output that tells of an error, or its last line."""
    lines = [line.strip() for line in text.splitlines() if line.strip() and not line.startswith((FAILED, "FAILED:"))]
    told = (line for line in lines if re.search(r"\berror\b\s*(:|--|[A-Z]+\d+)", line, re.IGNORECASE))
    return _shorten(next(told, lines[-1] if lines else text))


def _ask_for_toolkit() -> str:
    home = os.environ.get("CUDA_HOME") or os.environ.get("CUDA_PATH")
    nvcc = shutil.which("nvcc")
    found = f"CUDA_HOME is {home}" if home else "CUDA_HOME is not set, " + (f"nvcc is {nvcc}" if nvcc else "and there is no nvcc")
    wanted = f"install the CUDA toolkit {torch.version.cuda}, with which this torch was built, and a C++ compiler that it supports"
    return f"{found}; {wanted}, and set CUDA_HOME to it, {ELSE}"


def _shorten(text: str) -> str:
    return text if len(text) <= LONGEST else text[: LONGEST - 3] + "..."


def _place() -> Path:
    return cache_dir() / "gsplat.json"


def _key() -> str:
    """What a build depends on, as text."""
    version = "none"
    with suppress(importlib.metadata.PackageNotFoundError):
        version = importlib.metadata.version("gsplat")
    tools = [os.environ.get("CUDA_HOME"), os.environ.get("CUDA_PATH"), shutil.which("nvcc"), shutil.which("c++")]
    return f"gsplat {version}, torch {torch.__version__}, CUDA {torch.version.cuda}, {tools}"
