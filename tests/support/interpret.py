"""Run tests of the Triton kernels on the GPU if there is one, otherwise in Triton's interpreter on the CPU."""

import importlib
import json
import os
import subprocess
import sys
from typing import NamedTuple

import numpy as np
import pytest
import torch

DEVICE = "cuda" if torch.cuda.is_available() else "cpu"


def kernels(module: str = "scene_experts.scene.anchors.triton_kernels"):
    """Import the kernels of a module for DEVICE. Skips the test if triton is not installed (`make test` does not need it)."""
    if DEVICE == "cpu":
        os.environ["TRITON_INTERPRET"] = "1"  # read when a kernel is defined
    pytest.importorskip("triton", reason="triton is not installed")
    if DEVICE == "cpu":
        multiply_by_value()
    return importlib.import_module(module)


def multiply_by_value() -> None:
    """Let the interpreter round each element of a product by its row and column alone, as a GPU does.

    It calls BLAS, which on some processors rounds a row by its place in the block: then the same anchor in another block has other bits."""
    interpreter = importlib.import_module("triton.runtime.interpreter")

    def dot(self, a, b, d, input_precision, max_num_imprecise_acc):
        product = np.matmul(a.data, b.data, dtype=np.float64).astype(d.data.dtype)  # rounded once; einsum is ten times as slow
        return interpreter.TensorHandle(product + d.data, d.dtype.scalar)

    interpreter.InterpreterBuilder.create_dot = dot


def decode_by_triton(rows, xyz, feature, log_scaling, offsets, position, heads, with_dist, extent, outside, rounding=None):
    """`native_decode.decode` by the kernels, as a scene on CUDA calls them."""
    from scene_experts.scene.anchors import triton_decode

    columns = (feature, log_scaling, offsets)
    columns = columns if rounding is None else rounding.round(columns)
    return triton_decode.decode(rows, xyz, *columns, position, heads, with_dist, extent, outside)


COMPILE = """
import importlib, json, os, re, subprocess, sys, tempfile, triton
from triton.backends.compiler import GPUTarget
from triton.compiler import ASTSource
module, name, types, sizes, target, options = json.loads(sys.argv[1])
kernel = getattr(importlib.import_module(module), name)
signature = {p.name: "constexpr" if p.is_constexpr else types.get(p.name, "fp32") for p in kernel.params}
constants = {p.name: sizes[p.name] for p in kernel.params if p.is_constexpr}
aligned = {(i,): [["tt.divisibility", 16]] for i, p in enumerate(kernel.params) if signature[p.name].startswith("*")}
made = triton.compile(ASTSource(kernel, signature, constants, aligned), target=GPUTarget("cuda", target, 32), options=options)
tool = os.path.join(os.path.dirname(triton.__file__), "backends", "nvidia", "bin", "cuobjdump")
with tempfile.NamedTemporaryFile(suffix=".cubin") as file:
    file.write(made.asm["cubin"])
    file.flush()
    said = subprocess.run([tool, "-res-usage", file.name], capture_output=True, text=True)
found = re.search(r"REG:(\\d+) STACK:(\\d+)", said.stdout + said.stderr)
print("compiled", made.metadata.shared, *(found.groups() if found else (-1, -1)))
"""


class Usage(NamedTuple):
    """What a kernel takes of a GPU: bytes of shared memory for a block, registers and bytes of local memory for a thread."""

    shared: int
    registers: int
    local: int


def compile_for_gpu(module: str, name: str, types: dict[str, str], sizes: dict, target: int, **options) -> Usage:
    """Compile a kernel for a GPU of this compute capability, with addresses that 16 divides. Arguments without a type are fp32."""
    pytest.importorskip("triton", reason="triton is not installed")
    environment = {k: v for k, v in os.environ.items() if k != "TRITON_INTERPRET"} | {"PYTHONPATH": os.pathsep.join(sys.path)}
    given = json.dumps([module, name, types, sizes, target, options])
    done = subprocess.run([sys.executable, "-c", COMPILE, given], env=environment, capture_output=True, text=True, timeout=500)
    assert done.returncode == 0, done.stderr[-3000:]
    return Usage(*map(int, done.stdout.split()[-3:]))
