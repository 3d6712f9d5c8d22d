"""benchmarks/compare_checkouts.py: interleaved minima of two workers, and the ratio of each part."""

import sys

import pytest

import compare_checkouts as script


class Fake:
    """A worker whose times are given."""

    names = ("work",)

    def __init__(self, log, times):
        self.log, self.times, self.best = log, iter(times), {}

    def run(self, name):
        self.log.append(self)
        times = {"part": next(self.times)}
        self.best[name] = min(self.best.get(name, times), times, key=lambda t: t["part"])


def test_workers_take_turns_in_alternating_order():
    log = []
    other, this = Fake(log, [1, 2, 3]), Fake(log, [4, 5, 6])
    script.compare(other, this, 3)
    assert log == [other, this, this, other, other, this] and other.best == {"work": {"part": 1}}


def test_the_report_gives_the_ratio_of_each_part_and_returns_the_worst_whole(capsys):
    other = {"work": {"a": 1.0, "whole": 2.0}, "more": {"whole": 4.0}}
    this = {"work": {"a": 1.5, "whole": 2.2}, "more": {"whole": 4.0}}
    assert abs(script.report(other, this) - 1.1) < 1e-9
    assert "work, a" in (out := capsys.readouterr().out) and "1.500" in out


@pytest.mark.slow
def test_a_worker_times_every_part():
    worker = script.Worker(sys.executable, [60, 80, 48, 32])
    for name in worker.names:
        worker.run(name)
    worker.stop()
    assert set(worker.names) == {"step of moe-gs", "step of scaffold-gs", "raster", "raster, deterministic"}
    assert all(min(parts.values()) >= 0 and parts["whole"] > 0 for parts in worker.best.values())
    assert set(worker.best["raster"]) == {"forward", "backward", "whole"}
