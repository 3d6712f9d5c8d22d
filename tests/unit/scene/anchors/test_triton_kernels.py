"""The parts of the Triton kernels that the decode's own tests do not see, and whether the kernels compile for a GPU (none is needed)."""

import importlib

import pytest
import torch

from scene_experts.scene.anchors.mlp import ATTRIBUTES, CHANNELS, HeadWeights
from scene_experts.scene.anchors.triton_networks import KernelNetworks
from support.interpret import DEVICE, compile_for_gpu, kernels

triton_kernels = kernels()  # skips this file where triton is not installed
import triton  # noqa: E402
import triton.language as tl  # noqa: E402

TYPES = {"rows": "*i64", "order": "*i32", "keys": "*i32", "chosen": "*i64", "dst": "*i32", "source": "*i64", "positive": "*i32"}
TYPES |= {"counts": "*i32", "counted": "*i32", "A": "i32", "blocks": "i32", "stride": "i32", "to_stride": "i32"}
NUMBERS = ("extent", "volume", "hinge", "tau", "factor")
PHASES = {  # experts, those chosen (0: no router, None: all), hidden width; and the bytes of local memory that its kernels may take
    "scaffold-gs": (1, 0, 32, 0),
    "moe-gs, dense": (5, None, 32, 0),
    "moe-gs, sparse": (5, 2, 32, 32),
    "scene-experts, one": (1, 0, 64, 160),
    "scene-experts, places": (5, 1, 64, 64),
}


def networks(E, k, H, F=32, K=10):
    """The constants of a recipe's kernels."""
    heads = {}
    for a in ATTRIBUTES:
        out, router = K * CHANNELS[a], (None, None) if k == 0 else (torch.zeros(E, F), torch.zeros(E))
        shapes = (torch.zeros(E, H, F + 3), torch.zeros(E, H), torch.zeros(E, out, H), torch.zeros(E, out))
        heads[a] = HeadWeights(*router, *shapes, k or None)
    return KernelNetworks(heads, dict.fromkeys(heads, False), F, K, constant=True)


def usage(module, name, sizes, target):
    module = f"scene_experts.scene.anchors.{module}"
    kernel = getattr(importlib.import_module(module), name)
    types = {p: TYPES.get(p, "*fp32") for p in kernel.arg_names if p not in NUMBERS}
    options = {"num_warps": sizes["num_warps"]} if "num_warps" in sizes else {}
    return compile_for_gpu(module, name, types, {n: v for n, v in sizes.items() if n != "num_warps"}, target, **options)


@pytest.mark.slow
@pytest.mark.parametrize("phase", PHASES)
def test_the_networks_kernels_stay_in_registers(phase):
    """Of an H100. Local memory is 10 times as slow, and one kernel took 9 kB of it."""
    E, k, H, most = PHASES[phase]
    nets, by_row, alone = networks(E, k, H), k == 1, "shape_and_color_forward"
    found = {alone: usage("triton_kernels", alone, {**nets.rest, "BY_ROW": by_row}, 90)}
    found["opacity_forward"] = usage("triton_kernels", "opacity_forward", {**nets.opacity, "BY_ROW": by_row}, 90)
    for heads in [7] if nets.one_order else [1, 2, 4]:
        sizes = {
            "HEADS": heads,
            "ORDERED": bool(nets.ordered),
            "BY_ROW": by_row,
            "ADD": heads in (2, 4),
            "WITH_GATES": 2 * (k not in (0, 1)),
        }
        found[f"heads_backward {heads}"] = usage("triton_kernels", "heads_backward", {**nets.back, **sizes}, 90)
    found["heads_weights"] = usage("triton_kernels", "heads_weights", {**nets.sums, "BY_ROW": by_row}, 90)
    assert all(u.registers > 0 and 0 <= u.local <= most for u in found.values()), found


@pytest.mark.slow
@pytest.mark.parametrize("target", [80, 90])
def test_the_others_compile(target):
    small = {"K": 2, "B": 16, "KP": 2}
    nets = networks(3, 2, 16, 8, 2)
    for sizes in ({"RAW": True, "TERMS": False}, {"RAW": False, "TERMS": True}):
        usage("triton_places", "place_backward", {**small, **sizes}, target)
    usage("triton_places", "place", small, target)
    outside = {**nets.back, "OOUT": True, "HEADS": 1, "ORDERED": True, "BY_ROW": False, "ADD": False, "WITH_GATES": 1}
    usage("triton_kernels", "heads_backward", outside, target)


@triton.jit
def activations(x, a, s, ACT: tl.constexpr):
    at = tl.arange(0, 1024)
    value = triton_kernels.activate(tl.load(x + at), ACT)
    tl.store(a + at, value)
    tl.store(s + at, triton_kernels.derivative(value, ACT))


def test_activations_keep_their_precision():
    x = torch.cat([torch.logspace(-30, 1.5, 511), -torch.logspace(-30, 1.5, 511), torch.tensor([0.0, 100.0])])
    for act, function in ((0, torch.tanh), (1, lambda v: v), (2, torch.sigmoid)):
        exact = x.double().requires_grad_()
        expected = function(exact)
        (gradient,) = torch.autograd.grad(expected.sum(), exact)
        a, s = torch.empty(1024, device=DEVICE), torch.empty(1024, device=DEVICE)
        activations[(1,)](x.to(DEVICE), a, s, ACT=act)
        limit = (3e-7 + 1e-7 * exact.abs()) * expected.abs() + 1e-37  # a GPU's exp errs by its argument times 6e-8
        assert ((a.cpu().double() - expected).abs() <= limit).all()
        torch.testing.assert_close(s.cpu().double(), gradient, rtol=1e-4, atol=2e-7)
