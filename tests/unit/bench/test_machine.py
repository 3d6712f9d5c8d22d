"""Peak rates of the machine."""

import pytest

from scene_experts.bench import machine, peer
from scene_experts.native import library as native


def test_describe():
    found = machine.describe(2)
    assert found.processor and found.cores >= 1 and found.threads == 2 and set(found.levels) <= set(native.LEVELS)


def test_rates_are_plausible():
    assert 1e8 < machine.measure_copy(0.0) < 1e13
    if native.load() is None or peer.load(native.load().level) is None:
        pytest.skip("no compiled library or no peer")
    assert 1e8 < machine.measure_multiply_adds(None, 1, 0.0) < 1e13
    assert 1e8 < machine.measure_clock(native.load().level, 0.0) < 2e10


def test_more_busy_threads_than_cores_share_them(monkeypatch):
    cores = native.count_cores()
    monkeypatch.setattr(machine, "load_average", lambda: 0.0)
    assert machine.measure_share(cores, 0.0) == 1
    monkeypatch.setattr(machine, "load_average", lambda: None)
    assert 0 < machine.measure_share(1, 0.1) <= 1
    assert machine.measure_share(4 * cores, 0.2) < 0.5


def test_wider_vectors_multiply_faster():
    levels = [level for level in native.list_levels() if native.find(level)]
    if not {"portable", "avx2"} <= set(levels):
        pytest.skip("one instruction set alone")
    assert machine.measure_multiply_adds("avx2", 1, 0.05) > 1.3 * machine.measure_multiply_adds("portable", 1, 0.05)
