from dataclasses import replace

import pytest
import torch

from scene_experts.core.errors import InputError
from scene_experts.core.table import Table
from scene_experts.core.types import Decoded, Gaussians, Render
from scene_experts.native import library as native
from scene_experts.strategy import observe
from support.messages import naming

K = 3


def view(rows, raw, source, radii, grad) -> tuple[Decoded, Render]:
    m = len(source)
    g = Gaussians(torch.zeros(m, 3), torch.zeros(m, 4), torch.zeros(m, 3), torch.zeros(m), torch.zeros(m, 3), torch.tensor(source))
    render = Render(torch.zeros(2, 2, 3), torch.zeros(2, 2), torch.zeros(2, 2), torch.tensor(radii, dtype=torch.int32), torch.tensor(grad))
    return Decoded(g, torch.tensor(rows), torch.tensor(raw), {}), render


def test_counts_follow_the_rule_over_two_views():
    table = Table({"a": torch.zeros(4, 1)}, {})
    observe.start(table, K)
    # anchors 1 and 3 seen; slots 1:0, 1:2 and 3:1 positive; 1:2 missed the picture (radius 0)
    observe.observe(
        table, *view([1, 3], [[0.5, -0.2, 0.1], [-0.1, 0.7, -1.0]], [3, 5, 10], [4, 0, 2], [[3.0, 4.0], [9.0, 9.0], [0.0, 2.0]])
    )
    observe.observe(table, *view([1], [[0.25, -1.0, -1.0]], [3], [7], [[0.0, 1.0]]))
    torch.testing.assert_close(table.stats["visits"], torch.tensor([0.0, 2, 0, 1]))
    torch.testing.assert_close(table.stats["opacity"], torch.tensor([0.0, 0.85, 0, 0.7]))
    assert table.stats["grad"].reshape(-1)[[3, 5, 10]].tolist() == [6.0, 0.0, 2.0]  # norms 5 + 1, nothing, 2
    assert table.stats["count"].reshape(-1)[[3, 5, 10]].tolist() == [2.0, 0.0, 1.0]
    assert table.stats["grad"].sum() == 8 and table.stats["count"].sum() == 3
    observe.stop(table)
    assert not table.stats
    observe.stop(table)  # twice is fine


@pytest.mark.parametrize("name, shape", [("visits", (1,)), ("opacity", (4, K)), ("grad", (4,)), ("count", (4, K + 1))])
def test_statistics_of_other_shapes_are_refused(name, shape):
    table = Table({"a": torch.zeros(4, 1)}, {})
    observe.start(table, K)
    table.stats[name] = torch.zeros(shape)
    with pytest.raises(InputError, match=naming("4 rows", "3 slots", str(list(shape)))):
        observe.observe(table, *view([1], [[0.5, -0.2, 0.1]], [3], [4], [[3.0, 4.0]]))


def test_a_training_in_float64_counts_in_float64():
    table = Table({"a": torch.zeros(2, 1, dtype=torch.float64)}, {})
    observe.start(table, K)
    decoded, render = view([1], [[0.1, -0.2, 0.3]], [3, 5], [4, 0], [[3.0, 4.0], [9.0, 9.0]])
    decoded = replace(decoded, raw_opacity=torch.tensor([[0.1, -0.2, 0.3]], dtype=torch.float64))
    observe.observe(table, decoded, replace(render, mean2d_grad=render.mean2d_grad.double()))
    assert all(value.dtype == torch.float64 and not value.requires_grad for value in table.stats.values())
    assert float(table.stats["opacity"][1]) == 0.1 + 0.3 and float(table.stats["grad"].sum()) == 5


@pytest.mark.parametrize("K", [1, 4, 10, 33])
def test_the_compiled_form_gives_the_bits_of_the_plain_one(K):
    if native.load() is None:
        pytest.skip("no compiled library")
    generator = torch.Generator().manual_seed(K)
    n, rows = 3000, torch.arange(1, 3000, 2)
    raw = torch.randn(len(rows), K, generator=generator)
    keep = (raw > 0).view(-1).nonzero().squeeze(1)
    source = rows[keep // K] * K + keep % K
    empty = torch.empty(0)
    decoded = Decoded(Gaussians(empty, empty, empty, empty, empty, source), rows, raw, {})
    radii = torch.randint(-1, 4, (len(source),), dtype=torch.int32, generator=generator)
    size = 10.0 ** torch.empty(len(source), 1).uniform_(-9, 0, generator=generator)
    render = Render(empty, empty, empty, radii, torch.randn(len(source), 2, generator=generator) * size)
    tables = []
    for plain in (False, True):
        table = Table({"a": torch.zeros(n, 1)}, {})
        observe.start(table, K)
        for _ in range(3):
            observe._by_torch(table.stats, decoded, render) if plain else observe.observe(table, decoded, render)
        tables.append(table.stats)
    exact = torch.backends.cpu.get_cpu_capability().startswith("AVX")
    assert all(torch.equal(tables[0][k], tables[1][k]) if exact else torch.allclose(tables[0][k], tables[1][k]) for k in observe.STATS)
