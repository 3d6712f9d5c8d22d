"""Interleaved minima."""

import time
from types import SimpleNamespace

from scene_experts.bench import measure
from scene_experts.bench.measure import choose_clock, measure_minima


def test_minima_are_per_part_and_slow_subjects_run_once(monkeypatch):
    ticks = iter(range(1000))
    monkeypatch.setattr(measure, "time", SimpleNamespace(perf_counter=lambda: float(next(ticks)), thread_time=time.thread_time))
    seen = {"quick": 0, "slow": 0}
    parts = {"quick": [(5.0, 1.0), (3.0, 2.0), (4.0, 0.5)], "slow": [(9.0,)]}

    def subject(name):
        def run(clock):
            seen[name] += 1
            return parts[name][(seen[name] - 1) % len(parts[name])]

        return run

    best = measure_minima({name: subject(name) for name in parts}, 3.0, choose_clock(1), {"slow": 1})
    assert seen == {"quick": 3, "slow": 1}  # each run takes 1 s of this clock
    assert best == {"quick": (3.0, 0.5), "slow": (9.0,)}


def test_every_subject_runs_at_least_twice():
    seen = []
    measure_minima({"a": lambda clock: (float(len(seen)), seen.append(1))[:1]}, 0.0, choose_clock(2))
    assert len(seen) == 2


def test_slow_subjects_alone_terminate():
    seen = []
    measure_minima({"a": lambda clock: (float(len(seen)), seen.append(1))[:1]}, 5.0, choose_clock(2), {"a": 3})
    assert len(seen) == 3
