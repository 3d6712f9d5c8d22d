"""The parts of the Triton kernels that the decode's own tests do not see, and whether the kernels compile for a GPU (none is needed)."""

import os
import subprocess
import sys

import pytest
import torch

from support.interpret import DEVICE, kernels

triton_kernels = kernels()  # skips this file where triton is not installed
import triton  # noqa: E402
import triton.language as tl  # noqa: E402

COMPILE = """
import torch, triton
from triton.backends.compiler import GPUTarget
from triton.compiler import ASTSource
from scene_experts.scene.anchors import triton_decode, triton_kernels
from scene_experts.scene.anchors.mlp import HeadWeights

TYPES = {"rows": "*i64", "order": "*i64", "keys": "*i32", "chosen": "*i64", "dst": "*i32", "source": "*i64", "A": "i32", "blocks": "i32"}
TYPES["extent"] = "fp32"
F, K, H, E = 8, 2, 16, 3

def check(name, sizes, target):
    kernel = getattr(triton_kernels, name)
    signature = {p.name: "constexpr" if p.is_constexpr else TYPES.get(p.name, "*fp32") for p in kernel.params}
    constants = {p.name: sizes[p.name] for p in kernel.params if p.is_constexpr}
    triton.compile(ASTSource(kernel, signature, constants), target=GPUTarget("cuda", target, 32))

def head(a, k, E):
    out = K * triton_decode.CHANNELS[a]
    router = None if k == 0 else torch.zeros(E, F)
    weights = HeadWeights(router, None, torch.zeros(E, H, F + 3), torch.zeros(E, H), torch.zeros(E, out, H), torch.zeros(E, out), k or None)
    return triton_decode._head(a, weights, False, F, K).sizes

target = int(sys.argv[1])
common = {"B": 16, "EP": 16, "FP": 16, "KP": 2, "K": K}
check("place", common, target)
check("place_backward", common, target)
check("route", {**common, "F": F, "E": E, "TOP": 2, "BIAS": True, "POSITION": True, "PRECISION": "ieee"}, target)
for a, k, experts in (("opacity", 2, E), ("color", None, E), ("cov", 0, 1)):
    for kernel in ("head_forward", "head_backward", "weight_backward"):
        check(kernel, {**common, "POSITION": k == 2, "OUTSIDE": False, **head(a, k, experts)}, target)
check("head_backward", {**common, "POSITION": False, "OUTSIDE": True, **head("cov", 2, E)}, target)
print("compiled")
"""


@pytest.mark.slow
@pytest.mark.parametrize("target", ["80", "90"])
def test_the_kernels_compile(target):
    environment = {k: v for k, v in os.environ.items() if k != "TRITON_INTERPRET"} | {"PYTHONPATH": os.pathsep.join(sys.path)}
    script = "import sys; exec(sys.stdin.read())"
    # Kernels are compiled from their source files; only this driver comes over the pipe.
    done = subprocess.run(
        [sys.executable, "-c", script, target], input=COMPILE, env=environment, capture_output=True, text=True, timeout=500
    )
    assert done.returncode == 0 and "compiled" in done.stdout, done.stderr[-2000:]


@triton.jit
def activations(x, a, s, ACT: tl.constexpr):
    at = tl.arange(0, 1024)
    value = triton_kernels.activate(tl.load(x + at), ACT)
    tl.store(a + at, value)
    tl.store(s + at, triton_kernels.slope(value, ACT))


def test_activations_keep_their_precision():
    x = torch.cat([torch.logspace(-30, 1.5, 511), -torch.logspace(-30, 1.5, 511), torch.tensor([0.0, 100.0])])
    for act, function in ((0, torch.tanh), (1, lambda v: v), (2, torch.sigmoid)):
        exact = x.double().requires_grad_()
        expected = function(exact)
        (slope,) = torch.autograd.grad(expected.sum(), exact)
        a, s = torch.empty(1024, device=DEVICE), torch.empty(1024, device=DEVICE)
        activations[(1,)](x.to(DEVICE), a, s, ACT=act)
        limit = (3e-7 + 1e-7 * exact.abs()) * expected.abs() + 1e-37  # a GPU's exp errs by its argument times 6e-8
        assert ((a.cpu().double() - expected).abs() <= limit).all()
        torch.testing.assert_close(s.cpu().double(), slope, rtol=1e-4, atol=2e-7)
