"""The graph and its blend against slow loops over points, neighbours and channels; gradients by finite differences."""

import pytest
import torch

from scene_experts.native import library as native
from scene_experts.scene.graph.network import Graph, blend_neighbours


def points(n: int = 40, dtype: torch.dtype = torch.float64) -> torch.Tensor:
    return torch.randn(n, 3, dtype=dtype, generator=torch.Generator().manual_seed(0))


def features(n: int, F: int = 5) -> torch.Tensor:
    return torch.randn(n, F, dtype=torch.float64, generator=torch.Generator().manual_seed(2))


def slow(xyz: torch.Tensor, rows: list[int], f: torch.Tensor, k: int, share: float) -> torch.Tensor:
    """Steps 1 to 3 of the encoder as the paper states them; features f [A, F] of `rows`."""
    distance = torch.cdist(xyz, xyz)
    near = {u: [v for v in distance[u].argsort()[:k].tolist() if v in rows] for u in rows}  # edges to points unseen vanish
    place = {u: i for i, u in enumerate(rows)}
    h = {}
    for v in rows:
        known_by = [u for u in rows if v in near[u]]
        h[v] = torch.stack([f[place[v]] - f[place[u]] for u in known_by]).amax(0)
    out = f.clone()
    for u in rows:
        weight = {v: 0.0 if v == u else 1 / float(distance[u, v]) for v in near[u]}
        total = sum(weight.values())
        if total:
            mean = sum(weight[v] / total * h[v] for v in near[u]) / len(near[u])
            out[place[u]] = f[place[u]] + share * mean
    return out


@pytest.mark.parametrize(("seen", "k", "share"), [(40, 10, 0.5), (25, 10, 0.5), (12, 4, 1.0), (3, 2, 0.5)])
def test_the_blend_is_that_of_the_text(seen, k, share):
    xyz, rows = points(), torch.randperm(40, generator=torch.Generator().manual_seed(1))[:seen].sort().values
    f = features(seen)
    found = blend_neighbours(f, *Graph.of(xyz, k).among(rows), share)
    torch.testing.assert_close(found, slow(xyz, rows.tolist(), f, k, share))


def test_its_gradient_by_finite_differences():
    found, weight = Graph.of(points(), 7).among(torch.arange(0, 40, 2))
    f = features(20, 3).requires_grad_()
    assert torch.autograd.gradcheck(lambda f: blend_neighbours(f, found, weight, 0.7), (f,))


def test_equal_features_share_the_gradient_of_a_minimum():
    """At the start all features are 0: every maximum is a tie, and the gradient is the mean over those that attain it."""
    xyz = torch.tensor([[0.0, 0, 0], [1, 0, 0], [2.5, 0, 0]], dtype=torch.float64)
    found, weight = Graph.of(xyz, 2).among(torch.arange(3))
    assert found.tolist() == [[0, 1], [1, 0], [2, 1]]
    f = torch.zeros(3, 1, dtype=torch.float64, requires_grad=True)
    blend_neighbours(f, found, weight, 1.0)[0].sum().backward()
    # out_0 = f_0 + h_1 / 2 with h_1 = f_1 - min(f_0, f_1, f_2)
    assert f.grad is not None and f.grad.view(-1).tolist() == pytest.approx([1 - 1 / 6, 1 / 2 - 1 / 6, -1 / 6])


def test_a_graph_is_made_of_places_alone_and_lists_each_point_first():
    a, b = Graph.of(points(), 10), Graph.of(points().clone(), 10)
    assert torch.equal(a.index, b.index) and torch.equal(a.closeness, b.closeness)
    assert torch.equal(a.index[:, 0], torch.arange(40)) and not bool(a.closeness[:, 0].any())
    torch.testing.assert_close(a.closeness[:, 1:], 1 / torch.cdist(points(), points()).sort(dim=1).values[:, 1:10])


@pytest.mark.parametrize("n", [0, 1, 30])
def test_the_reverse_lists_every_edge_at_the_point_that_it_leads_to(n):
    graph = Graph.of(points(n), 4)
    start, known = graph.reverse
    assert start.shape == (n + 1,) and sorted(known.tolist()) == list(range(graph.index.numel()))
    for point in range(n):
        edges = known[start[point] : start[point + 1]].tolist()
        assert edges == (graph.index.view(-1) == point).nonzero().view(-1).tolist()


def test_a_changed_graph_keeps_its_neighbours():
    graph = Graph.of(points(), 4)
    single = graph.change(lambda t: t.float() if t.is_floating_point() else t)
    assert torch.equal(single.index, graph.index) and torch.equal(single.closeness, graph.closeness.float())


@pytest.mark.parametrize("n", [0, 1, 2])
def test_few_points(n):
    found, weight = Graph.of(points(n), 10).among(torch.arange(n))
    assert found.shape == weight.shape == (n, max(min(10, n), 1))
    f = features(n)
    assert torch.isfinite(blend_neighbours(f, found, weight)).all()
    if n == 1:
        assert torch.equal(blend_neighbours(f, found, weight), f)


def test_points_in_one_place_stay_finite():
    xyz = torch.zeros(4, 3)
    found, weight = Graph.of(xyz, 4).among(torch.arange(4))
    assert torch.isfinite(weight).all() and weight.sum(1).tolist() == pytest.approx([0.25] * 4)
    assert torch.isfinite(blend_neighbours(features(4).float(), found, weight)).all()


@pytest.mark.skipif(native.load() is None, reason="needs the compiled library")
@pytest.mark.parametrize(("n", "seen", "F"), [(3000, 1700, 32), (600, 600, 5), (50, 3, 32), (20, 0, 8), (1, 1, 1)])
def test_the_compiled_form_is_the_plain_one(n, seen, F, monkeypatch):
    found, weight = Graph.of(points(n, torch.float32), 10).among(torch.randperm(n)[:seen])
    f = features(seen, F).float().mul(3).round().requires_grad_()  # whole numbers: many ties
    up = torch.randn(seen, F)

    def both() -> tuple[torch.Tensor, torch.Tensor]:
        out = blend_neighbours(f, found, weight)
        return out.detach(), torch.autograd.grad(out, f, up)[0]

    compiled = both()
    assert all(torch.equal(a, b) for a, b in zip(compiled, both()))
    monkeypatch.setattr(native, "load", lambda level=None: None)
    for a, b in zip(compiled, both()):
        torch.testing.assert_close(a, b, rtol=1e-5, atol=1e-5)
