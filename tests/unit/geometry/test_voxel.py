from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from scene_experts.core.errors import InputError
from scene_experts.geometry import voxel
from support.messages import naming

AXIS = st.integers(-voxel.AXIS_LIMIT, voxel.AXIS_LIMIT - 1)


def random_cells(n: int, limit: int = 6) -> torch.Tensor:
    return torch.randint(-limit, limit, (n, 3), generator=torch.Generator().manual_seed(0))


def test_rounds_halves_to_even_as_numpy_does() -> None:
    points = torch.tensor([[0.5, 1.5, 2.5], [-0.5, -1.5, 0.49]], dtype=torch.float64)
    assert voxel.to_lattice(points, 1.0).tolist() == [[0, 2, 2], [0, -2, 0]]
    many = torch.randn(1000, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    assert (voxel.to_lattice(many, 0.003).numpy() == np.round(many.numpy() / 0.003).astype(np.int64)).all()


def test_an_outlier_that_overflows_int32_is_exact() -> None:
    assert voxel.to_lattice(torch.tensor([[3e5, 0, 0]], dtype=torch.float64), 1e-4)[0, 0] == 3_000_000_000


@pytest.mark.parametrize("bad", [float("nan"), float("inf"), 1e30])
def test_unusable_points_are_refused(bad: float) -> None:
    with pytest.raises(InputError):
        voxel.to_lattice(torch.tensor([[bad, 0.0, 0.0]]), 0.1)
    with pytest.raises(InputError):
        voxel.to_lattice(torch.zeros(1, 3), 0.0)


@given(st.lists(st.tuples(AXIS, AXIS, AXIS), min_size=2, max_size=20))
@settings(deadline=None, max_examples=50)
def test_keys_are_reversible_and_sort_as_cells_do(triples: list[tuple[int, int, int]]) -> None:
    cells = torch.tensor(triples)
    keys = voxel.pack(cells)
    assert torch.equal(voxel.unpack(keys), cells)
    assert (keys >= 0).all()
    assert [tuple(row) for row in voxel.unpack(keys.sort().values).tolist()] == sorted(triples)


@pytest.mark.parametrize("value", [voxel.AXIS_LIMIT, -voxel.AXIS_LIMIT - 1])
def test_a_cell_beyond_21_bits_is_refused(value: int) -> None:
    with pytest.raises(InputError, match=naming("--scene.voxel-size")):
        voxel.pack(torch.tensor([[0, value, 0]]))


def test_unique_cells_as_numpy() -> None:
    cells = random_cells(500, 3)
    unique, inverse = voxel.find_unique_cells(cells)
    expected, back = np.unique(cells.numpy(), axis=0, return_inverse=True)
    assert (unique.numpy() == expected).all() and (inverse.numpy() == back.reshape(-1)).all()
    assert torch.equal(unique[inverse], cells)
    empty, none = voxel.find_unique_cells(torch.zeros(0, 3, dtype=torch.int64))
    assert empty.shape == (0, 3) and none.shape == (0,)


@given(st.integers(-(2**20), 2**20), st.integers(1, 200))
@settings(deadline=None)
def test_coarsen_is_round_half_up_in_exact_arithmetic(i: int, m: int) -> None:
    expected = (2 * i + m) // (2 * m)  # floor((i + m/2) / m) over Python's unbounded integers
    assert voxel.coarsen(torch.tensor([i]), m).item() == expected
    assert abs(expected * m - i) * 2 <= m


def test_coarsen_ties_and_refusal() -> None:
    cells = torch.tensor([-6, -2, -1, 0, 1, 2, 6])
    assert voxel.coarsen(cells, 4).tolist() == [-1, 0, 0, 0, 0, 1, 2]
    assert torch.equal(voxel.coarsen(cells, 1), cells)
    with pytest.raises(ValueError, match=naming(1, 0)):
        voxel.coarsen(cells, 0)


def test_in_set() -> None:
    keys, others = voxel.pack(random_cells(300)), voxel.pack(random_cells(700, 4))
    expected = [k in set(others.tolist()) for k in keys.tolist()]
    assert voxel.in_set(keys, others).tolist() == expected and any(expected) and not all(expected)
    assert not voxel.in_set(keys, others[:0]).any()
    assert voxel.in_set(keys[:0], others).shape == (0,)


def test_scatter_max_is_by_element_and_keeps_negative_maxima() -> None:
    values = torch.tensor([[-1.0, 5.0], [-3.0, 7.0], [2.0, 2.0]])
    assert voxel.scatter_max(values, torch.tensor([0, 0, 2]), 3).tolist() == [[-1.0, 7.0], [0.0, 0.0], [2.0, 2.0]]


def test_automatic_size_on_a_grid() -> None:
    axis = torch.arange(10, dtype=torch.float64) * 0.1
    grid = torch.cartesian_prod(axis, axis, axis)
    assert voxel.estimate_voxel_size(grid) == pytest.approx(0.01)  # the squared spacing, as Scaffold-GS
    assert voxel.estimate_voxel_size(grid, "median_nn") == pytest.approx(0.1)
    assert voxel.estimate_voxel_size(grid, "median_nn", factor=0.5) == pytest.approx(0.05)


def test_automatic_size_takes_the_half_smallest() -> None:
    points = torch.randn(201, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    d2 = (points[:, None] - points[None]).square().sum(-1).fill_diagonal_(float("inf"))
    mean3 = d2.sort(dim=1).values[:, :3].mean(1).sort().values
    assert voxel.estimate_voxel_size(points) == pytest.approx(mean3[int(0.5 * 201) - 1].item())


def test_automatic_size_with_coincident_points() -> None:
    points = torch.zeros(40, 3, dtype=torch.float64)
    with pytest.raises(InputError, match=naming("--scene.voxel-size")):
        voxel.estimate_voxel_size(points)
    points[:4, 0] = torch.tensor([1.0, 2.0, 3.0, 4.0], dtype=torch.float64)
    assert voxel.estimate_voxel_size(points) > 0


def test_the_rules_for_a_voxel():
    grid = torch.cartesian_prod(*[torch.arange(6.0, dtype=torch.float64)] * 3) * 0.2
    assert voxel.choose_voxel_size(grid, "median_nn") == pytest.approx(0.2)
    assert voxel.choose_voxel_size(grid, "squared_median") == pytest.approx(0.04)
    assert voxel.choose_voxel_size(grid, "neighbours") == pytest.approx(0.05)


def test_coinciding_points_still_have_a_voxel_size():
    spread = torch.rand(10, 3, dtype=torch.float64)
    assert voxel.choose_voxel_size(torch.cat([spread] + [spread[:1]] * 30), "neighbours") > 0
    with pytest.raises(InputError, match=naming("--scene.voxel-size")):
        voxel.choose_voxel_size(spread[:1].repeat(5, 1), "neighbours")
