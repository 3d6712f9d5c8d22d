"""Run tests of the Triton kernels on the GPU if there is one, otherwise in Triton's interpreter on the CPU."""

import importlib
import json
import os
import subprocess
import sys

import pytest
import torch

DEVICE = "cuda" if torch.cuda.is_available() else "cpu"


def kernels(module: str = "scene_experts.scene.anchors.triton_kernels"):
    """Import the kernels of a module for DEVICE. Skips the test if triton is not installed (`make test` does not need it)."""
    if DEVICE == "cpu":
        os.environ["TRITON_INTERPRET"] = "1"  # read when a kernel is defined
    pytest.importorskip("triton", reason="triton is not installed")
    return importlib.import_module(module)


COMPILE = """
import importlib, json, sys, triton
from triton.backends.compiler import GPUTarget
from triton.compiler import ASTSource
module, name, types, sizes, target, options = json.loads(sys.argv[1])
kernel = getattr(importlib.import_module(module), name)
signature = {p.name: "constexpr" if p.is_constexpr else types.get(p.name, "fp32") for p in kernel.params}
constants = {p.name: sizes[p.name] for p in kernel.params if p.is_constexpr}
made = triton.compile(ASTSource(kernel, signature, constants), target=GPUTarget("cuda", target, 32), options=options)
print("compiled", made.metadata.shared)
"""


def compile_for_gpu(module: str, name: str, types: dict[str, str], sizes: dict, target: int, **options) -> int:
    """Compile a kernel for a GPU of this compute capability and return its bytes of shared memory. Arguments without a type are fp32."""
    pytest.importorskip("triton", reason="triton is not installed")
    environment = {k: v for k, v in os.environ.items() if k != "TRITON_INTERPRET"} | {"PYTHONPATH": os.pathsep.join(sys.path)}
    given = json.dumps([module, name, types, sizes, target, options])
    done = subprocess.run([sys.executable, "-c", COMPILE, given], env=environment, capture_output=True, text=True, timeout=500)
    assert done.returncode == 0, done.stderr[-3000:]
    return int(done.stdout.split()[-1])
