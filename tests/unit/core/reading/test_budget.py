"""Budgets: what honest files need is far below them."""

import pytest

from scene_experts.core.reading import budget
from scene_experts.files.formats.pack import decoded_bytes


def test_every_budget_names_its_files_and_allows_honest_ones():
    found = [value for value in vars(budget).values() if isinstance(value, budget.Budget)]
    assert len(found) > 15 and all(b.what and b.advice and 0 < b.floor <= 512 << 20 for b in found)
    assert budget.PLY.bytes_in > 10_000_000 * 62 * 4
    assert budget.COMPACT.bytes_in > 2_000_000 * 316 and budget.COMPACT.allowance(300 << 20) > 2_000_000 * 80 * 8
    assert budget.JSON.bytes_in > 5_000 * 2_000


LEAST = [(budget.SPZ, 16), (budget.SOG, 13), (budget.HTML, 21), (budget.COMPRESSED_PLY, 61), (budget.GLB, 236)]


@pytest.mark.parametrize(("of", "least"), LEAST)
def test_large_files_of_gaussians_are_honest(of, least):
    """Ten million Gaussians of degree 3 in the fewest bytes that a trained scene takes. The parts of an archive count as well."""
    count = 10_000_000
    assert of.allowance(count * least) > count * (decoded_bytes(3) + least)


def test_allowances_grow_with_the_file():
    b = budget.Budget("x", 100, floor=10, ratio=3, seconds=1.0)
    assert b.allowance(0) == 10 and b.allowance(100) == 310
    assert b.time_limit(0) == 1.0 < b.time_limit(1 << 30)
