"""Pickles as data. The attacks on whole files are in test_export_layout_torch_archive.py."""

import math
import pickle
from collections import OrderedDict
from decimal import Decimal

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from scene_experts.core.reading import pickle_data
from scene_experts.core.reading.pickle_data import Global, NotData, ObjectRecord, Outside, decode

PLAIN = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats(allow_nan=False) | st.text(),
    lambda inner: st.lists(inner, max_size=4) | st.tuples(inner, inner) | st.dictionaries(st.text(), inner, max_size=4),
    max_leaves=12,
)


@settings(max_examples=60, deadline=None)
@given(value=PLAIN, protocol=st.integers(0, 5))
def test_plain_values_are_what_pickle_itself_reads(value, protocol):
    assert decode(pickle.dumps(value, protocol=protocol)) == value


def test_an_object_becomes_a_record_of_its_name_and_arguments():
    found = decode(pickle.dumps(Decimal("1.5"), protocol=2))
    assert isinstance(found, ObjectRecord) and found.what == Global("decimal", "Decimal") and found.args == ("1.5",)
    found = decode(pickle.dumps(OrderedDict(a=1), protocol=2))
    assert isinstance(found, ObjectRecord) and str(found.what) == "collections.OrderedDict" and found.items == {"a": 1}
    assert decode(pickle.dumps(math.sin, protocol=2)) == Global("math", "sin")


def test_a_reference_to_the_outside_keeps_its_key():
    assert decode(b"\x80\x02X\x01\x00\x00\x00kQ.") == Outside("k")


def test_a_pickle_too_large_to_be_a_network(monkeypatch):
    monkeypatch.setattr(pickle_data, "SIZE_LIMIT", 10)
    with pytest.raises(NotData, match="11"):
        decode(b"x" * 11)
    with pytest.raises(NotData):
        decode(b"\x80\x04N")  # no end
