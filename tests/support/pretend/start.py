"""Start a process in which tensors can pretend to be on CUDA."""

import importlib.util
import json
import os
import shutil
import subprocess
import sys
from functools import cache
from pathlib import Path
from typing import Any

import pytest
import torch

TESTS = Path(__file__).parents[2]
LONGEST = 900.0  # seconds of a process; the interpreter of Triton takes milliseconds for each operation of a kernel


def explain_missing() -> str | None:
    """Return None if the process can be started, otherwise what is missing."""
    if torch.cuda.is_available():
        return "a CUDA device is there: the gpu tests run on it"
    if shutil.which("g++") is None or sys.platform != "linux":
        return "g++ on Linux is needed to build the guard"
    missing = [name for name in ("gsplat", "jaxtyping", "triton") if importlib.util.find_spec(name) is None]
    return f"{', '.join(missing)} not installed: use `make pretend`" if missing else None


@cache
def build_guard(folder: Path) -> Path:
    """Compile the guard into `folder` and return the library."""
    root, library = Path(torch.__file__).parent, folder / "libguard.so"
    include, lib = root / "include", root / "lib"
    command = ["g++", "-std=c++20", "-shared", "-fPIC", f"-I{include}", str(Path(__file__).parent / "guard.cpp"), "-o", str(library)]
    subprocess.run([*command, f"-L{lib}", "-lc10", f"-Wl,-rpath,{lib}"], check=True, capture_output=True, timeout=300)
    return library


def make_environment(folder: Path) -> dict[str, str]:
    """Return the environment of a process in which tensors can pretend. The guard is built in `folder`."""
    path = os.pathsep.join([str(TESTS), *sys.path])
    return os.environ | {"LD_PRELOAD": str(build_guard(folder)), "PYTHONPATH": path, "TRITON_INTERPRET": "1", "OMP_NUM_THREADS": "1"}


def run(folder: Path, module: str, *arguments: str) -> Any:
    """Run `python -m support.pretend.MODULE ARGUMENTS` with the guard, and return the JSON that it prints last."""
    reason = explain_missing()
    if reason is not None:
        pytest.skip(reason)
    command = [sys.executable, "-m", f"support.pretend.{module}", *arguments]
    done = subprocess.run(command, cwd=TESTS, env=make_environment(folder), capture_output=True, text=True, timeout=LONGEST)
    assert done.returncode == 0, done.stderr[-6000:]
    return json.loads(done.stdout.strip().splitlines()[-1])
