"""Keys along the Morton curve."""

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from scene_experts.files.formats.morton import AXIS_BITS, morton, unmorton

TOP = (1 << AXIS_BITS) - 1


def interleaved(x, y, z):
    return sum(((v >> bit) & 1) << (3 * bit + axis) for axis, v in enumerate((x, y, z)) for bit in range(AXIS_BITS))


@settings(max_examples=60, deadline=None)
@given(st.lists(st.tuples(*[st.integers(0, TOP)] * 3), max_size=20))
def test_keys_interleave_bits_and_come_back(cells):
    assert interleaved(TOP, TOP, TOP) == 2**63 - 1
    array = np.array(cells, np.int64).reshape(-1, 3)
    keys = morton(array)
    assert keys.tolist() == [interleaved(*c) for c in cells]
    assert np.array_equal(unmorton(keys), array)
