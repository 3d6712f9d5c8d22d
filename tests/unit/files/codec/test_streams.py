"""Streams of the compiled library: byte for byte those of the reference, and no damage goes unnoticed."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from scene_experts.core.reading.budget import Damaged
from scene_experts.files.codec import reference, streams
from scene_experts.files.codec.streams import SymbolReader, SymbolWriter
from scene_experts.native import library as native

pytestmark = pytest.mark.skipif(native.load() is None, reason="no compiled library")
EDGES = [0, 1, -1, 40, 41, -41, 72, -73, 1 << 14, -(1 << 20), (1 << 31) - 1, -(1 << 31)]


def symbols(seed, n=400):
    """Values around their means, some far away, and scales of all sizes."""
    rng = np.random.default_rng(seed)
    scale = rng.integers(-3, 131, n).astype(np.int32)
    mean = rng.integers(-9000, 9000, n).astype(np.int32)
    spread = 2.0 ** (scale.clip(0, 127) / 8 - 4)
    values = np.rint(mean / 8 + rng.logistic(size=n) * spread).astype(np.int64)
    values[: len(EDGES)], mean[3:6] = EDGES, [1 << 30, -(1 << 31), (1 << 31) - 1]
    return values.clip(-(1 << 31), (1 << 31) - 1).astype(np.int32), mean, scale


def write(slow, seed=0):
    out, (values, mean, scale) = SymbolWriter(slow), symbols(seed)
    rng = np.random.default_rng(seed + 1)
    bits, odds = rng.integers(0, 2, 300).astype(np.uint8), rng.integers(-5, 140, 300).astype(np.int32)
    keys = np.unique(rng.integers(0, 1 << 15, 200)).astype(np.int64)
    out.symbols(values, mean, scale)
    out.bits(bits, odds)
    out.cells(keys, 5)
    out.symbols(values[::-1], mean[::-1], scale[::-1])
    return out, values, mean, scale, bits, odds, keys


def test_the_bytes_are_those_of_the_reference_and_come_back():
    fast, slow = write(False), write(True)
    data = fast[0].pack()
    assert data == slow[0].pack() and len(data) < fast[0].ideal_bits / 8 + 20
    _, values, mean, scale, bits, odds, keys = fast
    for reader in (SymbolReader(data), SymbolReader(data, slow=True)):
        assert np.array_equal(reader.symbols(mean, scale), values)
        assert np.array_equal(reader.bits(odds), bits)
        assert np.array_equal(reader.cells(5, len(keys)), keys)
        assert np.array_equal(reader.symbols(mean[::-1], scale[::-1]), values[::-1])
        reader.finish()


def test_an_empty_stream_and_one_cell():
    out = SymbolWriter()
    out.cells(np.zeros(1, np.int64), 0)
    out.symbols(*[np.zeros(0, np.int32)] * 3)
    assert len(out.pack()) == 16
    reader = SymbolReader(out.pack())
    assert reader.cells(0, 1).tolist() == [0]
    reader.finish()


@settings(max_examples=60, deadline=None)
@given(st.integers(0, 10_000), st.binary(max_size=4), st.integers(0, 2000))
def test_damage_ends_in_an_error_or_in_numbers_alike_in_both(seed, patch, place):
    data = bytearray(write(False)[0].pack())
    data[place : place + len(patch)] = patch
    data = bytes(data[: len(data) - seed % 3 * 2])
    _, mean, scale = symbols(0)
    found = []
    for slow in (False, True):
        try:
            reader = SymbolReader(data, slow)
            found.append(reader.symbols(mean, scale).tolist())
        except Damaged:
            found.append(None)
    assert found[0] == found[1]


@pytest.mark.parametrize("data", [b"", b"\0" * 15, b"\0" * 16, b"\xff" * 16, b"\xff" * 40])
def test_streams_that_are_none(data):
    with pytest.raises(Damaged):
        reader = SymbolReader(data)
        reader.symbols(np.zeros(400, np.int32), np.full(400, 60, np.int32))
        reader.finish()


def test_random_words_never_read_outside():
    rng = np.random.default_rng(5)
    for _ in range(100):
        data = rng.integers(0, 256, 64, dtype=np.uint8).tobytes()
        for use in (
            lambda r: r.cells(21, 1000),
            lambda r: r.symbols(np.zeros(200, np.int32), np.full(200, 127, np.int32)),
            lambda r: r.finish(),
        ):
            with pytest.raises(Damaged):
                use(SymbolReader(data))


def test_a_stream_with_more_than_its_contents():
    out = SymbolWriter()
    out.bits(np.ones(100, np.uint8), np.full(100, 64, np.int32))
    reader = SymbolReader(out.pack())
    reader.bits(np.full(99, 64, np.int32))
    with pytest.raises(Damaged):
        reader.finish()


def test_contexts_are_those_of_the_reference():
    rng = np.random.default_rng(3)
    n, D = 1500, 70
    inputs = rng.integers(-2047, 2048, (D + 3, n)).astype(np.int16)
    weights, classes = rng.integers(-127, 128, (2, D)).astype(np.int8), rng.integers(-2, 5, n).astype(np.int8)
    for numbers in ((1 << 27, 12, -5000, 9), (-77, -4, 3, 0), (0, 0, 1 << 28, -5)):
        for a, b in zip(
            streams.predict(streams.Inputs(inputs), weights, numbers, classes), reference.predict(inputs[:D], weights, numbers, classes)
        ):
            assert np.array_equal(a, b)
    weights[:, 3:40], weights[0, 40:50], weights[1, 45:60] = 0, 0, 0
    for used, rows in ((D, 0), (D, 15), (D, 16), (D, 1041), (0, 40), (1, 40), (5, 40), (50, 40)):
        some, few, its = np.ascontiguousarray(inputs[:, :rows]), weights[:, :used], classes[:rows]
        found = (
            streams.predict(streams.Inputs(some[:3], some[3:]), few, (-77, 4, 3, 2), its),
            reference.predict(some[:used], few, (-77, 4, 3, 2), its),
        )
        assert all(np.array_equal(a, b) for a, b in zip(*found)), (used, rows)
    values = rng.integers(-(1 << 31), 1 << 31, n).astype(np.int32)
    values[: n // 2] >>= 20
    for factor, offset in ((1, 0), (1 << 20, -(1 << 28)), (700, 123456)):
        assert np.array_equal(streams.as_inputs(values, classes, factor, offset), reference.as_inputs(values, classes, factor, offset))
    for C, N in ((1, n), (7, 33), (70, 16), (96, 5), (3, 0)):
        whole, steps = rng.integers(-(1 << 30), 1 << 30, (C, N)).astype(np.int32), rng.random(C).astype(np.float32)
        for scale in (None, 2.0 ** rng.integers(-2, 5, N).astype(np.float32)):
            assert np.array_equal(streams.restore(whole, steps, scale), reference.restore(whole, steps, scale))
    cells = rng.integers(0, 1 << 21, (400, 3)).astype(np.int32)
    rows, coarse = np.arange(1, 400, 2, dtype=np.int32), np.arange(0, 400, 8, dtype=np.int32)
    for some in (coarse, coarse[:1], coarse[:0]):
        found, wanted = streams.find_parents(cells, rows, some), reference.find_parents(cells, rows, some)
        assert all(np.array_equal(a, b) for a, b in zip(found, wanted)) and (found[1].sum(1) <= 256).all()
        assert np.array_equal(streams.blend(inputs, *found), reference.blend(inputs, *wanted))
