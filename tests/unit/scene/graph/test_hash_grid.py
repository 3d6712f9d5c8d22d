"""The hash grid against the formula, corner by corner, and its gradient by finite differences."""

import copy
import itertools

import pytest
import torch

from scene_experts.core.errors import InputError
from scene_experts.core.fields import check_fields
from scene_experts.native import library as native
from scene_experts.scene.graph.hash_grid import PRIMES, Grid, HashGrid, encode
from support.messages import naming

SMALL = HashGrid(levels=5, features=3, log2_table=7, base=2, growth=1.6)


def built(config: HashGrid = SMALL, dtype: torch.dtype = torch.float64) -> Grid:
    torch.manual_seed(0)
    grid = config.build((-1.0, 0.0, 2.0), 4.0).to(dtype)
    grid.table.data.normal_()
    return grid


def places(n: int = 40) -> torch.Tensor:
    return torch.rand(n, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(1)) * 4 + torch.tensor([-1.0, 0, 2])


def slow(grid: Grid, xyz: torch.Tensor) -> torch.Tensor:
    """Instant NGP, eq. 2 to 4, one place, level and corner at a time."""
    out, config = [], grid.config
    for place in grid.unit(xyz):
        values, first = [], 0
        for level in range(config.levels):
            cells = int(config.base * config.growth**level)
            rows = min((cells + 1) ** 3, 2**config.log2_table)
            low = (place * cells).floor().long()
            part = place * cells - low
            total = torch.zeros(config.features, dtype=xyz.dtype)
            for corner in itertools.product((0, 1), repeat=3):
                at = [int(low[a]) + corner[a] for a in range(3)]
                weight = 1.0
                for a in range(3):
                    weight *= float(part[a]) if corner[a] else 1 - float(part[a])
                if rows == (cells + 1) ** 3:
                    row = at[0] + (cells + 1) * (at[1] + (cells + 1) * at[2])
                else:
                    row = ((at[0] * PRIMES[0]) ^ (at[1] * PRIMES[1]) ^ (at[2] * PRIMES[2])) % rows
                total += weight * (grid.table[first + row % rows] if weight else 0)
            values.append(total)
            first += rows
        out.append(torch.cat(values))
    return torch.stack(out)


def test_features_are_those_of_the_formula():
    grid = built(HashGrid(levels=5, features=3, log2_table=7, base=2, growth=1.6))
    torch.testing.assert_close(grid(places()), slow(grid, places()))
    torch.testing.assert_close(copy.deepcopy(grid).float()(places().float()), slow(grid, places()).float(), rtol=1e-4, atol=1e-4)


def test_the_cube_holds_its_ends_and_places_outside_count_as_on_its_side():
    grid = built()
    ends = torch.tensor([[-1.0, 0, 2], [3, 4, 6], [3, 0, 6]], dtype=torch.float64)
    torch.testing.assert_close(grid(ends), slow(grid, ends))
    torch.testing.assert_close(
        grid(torch.tensor([[9.0, 4, -5]], dtype=torch.float64)), grid(torch.tensor([[3.0, 4, 2]], dtype=torch.float64))
    )


def test_a_table_row_at_a_corner_is_met_unblended():
    grid = built(HashGrid(levels=1, features=2, base=4, growth=1.0))
    corner = torch.tensor([[-1.0 + 1, 0 + 2, 2 + 3]], dtype=torch.float64)  # cell edge 1: corner (1, 2, 3)
    torch.testing.assert_close(grid(corner)[0], grid.table[1 + 5 * (2 + 5 * 3)])


def test_levels_and_rows_of_sags():
    config = HashGrid()
    assert config.resolutions()[:4] == [16, 23, 33, 48] and config.width == 32
    assert config.rows()[:3] == [17**3, 24**3, 2**15] and sum(config.rows()) == 17**3 + 24**3 + 14 * 2**15
    table = HashGrid().build((0, 0, 0), 1).table.detach()
    assert 0.9e-4 < float(table.abs().max()) <= 1e-4


@pytest.mark.slow
def test_gradient_of_the_table_by_finite_differences():
    grid = built()
    assert torch.autograd.gradcheck(lambda table: encode(table, grid.unit(places(9)), grid.config), (grid.table,))


def test_no_places_and_sizes_that_cannot_be():
    assert built()(places(0)).shape == (0, 15)
    check_fields(HashGrid(), "scene.grid")
    for wrong, flag in (({"levels": 0}, "levels"), ({"log2_table": 0}, "log2-table"), ({"log2_table": 60}, "log2-table")):
        with pytest.raises(InputError, match=naming(f"--scene.grid.{flag}")):
            check_fields(HashGrid(**wrong), "scene.grid")


def test_cells_too_fine_to_number_are_refused():
    check_fields(HashGrid(levels=64), "scene.grid")
    for wrong in ({"levels": 64, "growth": 2.0}, {"levels": 64, "growth": 1e6}, {"growth": 1e300}):
        with pytest.raises(InputError, match=naming("--scene.grid.levels", "--scene.grid.growth")):
            check_fields(HashGrid(**wrong), "scene.grid")


@pytest.mark.skipif(native.load() is None, reason="needs the compiled library")
@pytest.mark.parametrize("config", [HashGrid(), SMALL, HashGrid(levels=3, features=1), HashGrid(levels=2, base=2**21 - 1, growth=1.5)])
def test_the_compiled_form_is_the_plain_one(config, monkeypatch):
    grid = built(config, torch.float32)
    for n in (0, 1, 1500):
        xyz = places(n).float()
        up = torch.randn(n, config.width)

        def both(xyz=xyz, up=up) -> tuple[torch.Tensor, torch.Tensor]:
            out = grid(xyz)
            return out.detach(), torch.autograd.grad(out, grid.table, up)[0]

        compiled = both()
        assert all(torch.equal(a, b) for a, b in zip(compiled, both()))
        with monkeypatch.context() as without:
            without.setattr(native, "load", lambda level=None: None)
            for a, b in zip(compiled, both()):
                torch.testing.assert_close(a, b, rtol=1e-4, atol=1e-4)
