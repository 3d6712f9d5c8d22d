"""Which photographs are compared."""

import pytest

from scene_experts.sfm.pairs import MOST, pairs


def test_all_with_all_up_to_a_number_and_neighbours_beyond():
    assert len(pairs(5)) == 10 and len(pairs(MOST)) == MOST * (MOST - 1) // 2
    assert len(pairs(MOST + 1)) < 16 * MOST
    assert pairs(MOST + 1, "exhaustive")[-1] == (MOST - 1, MOST)


@pytest.mark.parametrize("count", [1, 2, 11, 40])
def test_sequential_is_the_next_ones_and_powers_of_two(count):
    steps = {1, 2, 3, 4, 8, 16, 32}
    assert set(pairs(count, "sequential", neighbours=3)) == {(i, j) for i in range(count) for j in range(i + 1, count) if j - i in steps}
