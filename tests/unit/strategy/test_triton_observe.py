"""The statistics of a view as a Triton kernel against plain torch."""

import pytest
import torch

from scene_experts.core.types import Decoded, Gaussians, Render
from scene_experts.native import triton
from scene_experts.strategy import observe
from support.interpret import DEVICE, compile_for_gpu, kernels

MODULE = "scene_experts.strategy.triton_observe"


def view(A, N, K, seed):
    g = torch.Generator().manual_seed(seed)
    rows = torch.randperm(N, generator=g)[:A].sort().values
    raw = torch.randn(A, K, generator=g)
    source = (rows[:, None] * K + torch.arange(K)).view(-1)[raw.view(-1) > 0]
    M = len(source)
    radii = torch.randint(0, 3, (M,), generator=g, dtype=torch.int32)
    grad = torch.randn(M, 2, generator=g)
    parts = [t.to(DEVICE) for t in (rows, raw, source, radii, grad)]
    gaussians = Gaussians(*(torch.zeros(M, n) for n in (3, 4, 3)), torch.zeros(M), torch.zeros(M, 3), parts[2])
    blank = torch.zeros(1, 1)
    return Decoded(gaussians, parts[0], parts[1], {}), Render(blank, blank, blank, parts[3], parts[4])


@pytest.mark.parametrize(("A", "N", "K"), [(150, 200, 10), (3, 5, 1), (1, 1, 4), (0, 4, 3)])
@pytest.mark.parametrize("anchors", [True, False])
def test_the_statistics_of_torch(A, N, K, anchors, monkeypatch):
    kernels(MODULE)
    shapes = {"visits": (N,), "opacity": (N,), "grad": (N, K), "count": (N, K)}
    ours, expected = ({n: torch.ones(s, device=DEVICE) for n, s in shapes.items()} for _ in range(2))
    for seed in range(2):
        decoded, render = view(A, N, K, seed)
        observe._launch(ours, decoded, render, decoded.raw_opacity if anchors else None)
        (observe._by_torch if anchors else observe._drawn_by_torch)(expected, decoded, render)
    for name, value in expected.items():
        torch.testing.assert_close(ours[name], value, rtol=2e-6, atol=1e-6)
    assert torch.equal(ours["count"], expected["count"]) and torch.equal(ours["visits"], expected["visits"])


def test_a_cpu_keeps_its_own_form():
    assert not triton.covers(torch.zeros(3))


@pytest.mark.slow
@pytest.mark.parametrize("target", [80, 90])
def test_it_compiles(target):
    types = {"rows": "*i64", "source": "*i64", "radii": "*i32", "A": "i32", "M": "i32"}
    types |= dict.fromkeys(("raw", "grad2d", "visits", "opacity", "grad", "count"), "*fp32")
    compile_for_gpu(MODULE, "observe", types, {"ANCHORS": True, "K": 10, "B": 64, "KP": 16, "BM": 256}, target)
