"""The Morton code against bits interleaved one by one, and steps of every length."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from scene_experts.files.anchors.lattice_code import AXIS_BITS, decode_steps, encode_steps, morton, unmorton

TOP = (1 << AXIS_BITS) - 1


def interleaved(x, y, z):
    return sum(((v >> bit) & 1) << (3 * bit + axis) for axis, v in enumerate((x, y, z)) for bit in range(AXIS_BITS))


@settings(max_examples=60, deadline=None)
@given(st.lists(st.tuples(*[st.integers(0, TOP)] * 3), max_size=20))
def test_keys_interleave_bits_and_come_back(cells):
    array = np.array(cells, np.int64).reshape(-1, 3)
    keys = morton(array)
    assert keys.tolist() == [interleaved(*c) for c in cells]
    assert np.array_equal(unmorton(keys), array)


@settings(max_examples=100, deadline=None)
@given(st.lists(st.integers(0, 2**63 - 1), max_size=50))
def test_steps_come_back(keys):
    array = np.sort(np.array(keys, np.uint64))
    assert np.array_equal(decode_steps(encode_steps(array)), array)


def test_short_steps_take_one_byte_and_the_longest_nine():
    assert len(encode_steps(np.array([0, 0, 127, 254], np.uint64))) == 4
    assert len(encode_steps(np.array([128], np.uint64))) == 2
    assert len(encode_steps(np.array([2**63 - 1], np.uint64))) == 9
    assert interleaved(TOP, TOP, TOP) == 2**63 - 1


@pytest.mark.parametrize("data", [[0x80], [0, 0x80], [0x80] * 9 + [0], [0xFF] * 20])
def test_bytes_that_are_no_steps(data):
    with pytest.raises(ValueError):
        decode_steps(np.array(data, np.uint8))
