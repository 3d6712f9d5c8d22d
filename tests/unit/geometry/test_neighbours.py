from __future__ import annotations

import pytest
import torch

from scene_experts.geometry import neighbours
from scene_experts.geometry.neighbours import find_neighbours, knn_d2, median_neighbour_distance


def cloud(kind: str, n: int = 1500) -> torch.Tensor:
    generator = torch.Generator().manual_seed(0)
    points = torch.randn(n, 3, generator=generator, dtype=torch.float64)
    if kind == "duplicates":
        points[: n // 2] = points[0]
    if kind == "pairs":
        points[n // 2 :] = points[: n // 2]
    if kind == "outliers":
        points[:7] *= 1e6
    if kind == "flat":
        points[:, 2] = 0.5
    if kind == "lattice":
        points = torch.randint(0, 9, (n, 3), generator=generator).double()  # many equal distances
    return points


def brute(points: torch.Tensor, k: int) -> torch.Tensor:
    """The same sums in the same order, so that not even a bit differs."""
    gap = (points[:, None] - points[None]).square()
    return (gap[..., 0] + gap[..., 1] + gap[..., 2]).fill_diagonal_(float("inf")).sort(dim=1).values[:, :k]


@pytest.mark.parametrize("kind", ["normal", "duplicates", "pairs", "outliers", "flat", "lattice"])
@pytest.mark.parametrize("k", [1, 3, 10])
def test_same_as_all_pairs(kind: str, k: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(neighbours, "_CHUNK", 600)
    points = cloud(kind)
    d2, index = find_neighbours(points, k)
    assert torch.equal(d2, brute(points, k))
    torch.testing.assert_close((points[index] - points[:, None]).square().sum(-1), d2, rtol=1e-12, atol=0)
    assert (index != torch.arange(len(points))[:, None]).all()
    assert (index.sort(dim=1).values.diff(dim=1) > 0).all()  # no neighbour twice
    same = d2.diff(dim=1) == 0
    assert (index.diff(dim=1)[same] > 0).all()  # equally near ones by their indices
    assert all(torch.equal(a, b) for a, b in zip(find_neighbours(points, k), (d2, index)))


def test_the_number_of_threads_changes_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    points, found = cloud("lattice"), []
    for threads in (1, 3):
        monkeypatch.setattr(neighbours.native, "count_threads", lambda threads=threads: threads)
        found.append(find_neighbours(points, 5))
    assert all(torch.equal(a, b) for a, b in zip(*found))


def test_positions_that_are_not_finite_are_refused() -> None:
    for wrong in (float("nan"), float("inf")):
        with pytest.raises(ValueError, match="finite"):
            find_neighbours(torch.tensor([[0.0, 0, 0], [1, 1, 1], [wrong, 0, 0]]), 1)


def test_few_points() -> None:
    assert knn_d2(torch.zeros(0, 3)).shape == (0,)
    assert knn_d2(torch.ones(1, 3)).tolist() == [0.0]
    two = torch.tensor([[0.0, 0, 0], [3, 4, 0]])
    assert knn_d2(two).tolist() == [25.0, 25.0]
    three = torch.tensor([[0.0, 0, 0], [1, 0, 0], [3, 0, 0]])
    assert knn_d2(three).tolist() == [5.0, 2.5, 6.5]
    assert knn_d2(torch.ones(500, 3)).tolist() == [0.0] * 500


def test_lattice_spacing() -> None:
    axis = torch.arange(12, dtype=torch.float64)
    grid = torch.cartesian_prod(axis, axis, axis) * 0.25
    assert knn_d2(grid).tolist() == pytest.approx([0.0625] * len(grid))
    assert median_neighbour_distance(grid) == pytest.approx(0.25)
    assert median_neighbour_distance(grid[:1]) == 0.0
