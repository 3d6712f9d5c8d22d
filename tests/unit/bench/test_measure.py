"""Interleaved minima."""

from scene_experts.bench.measure import choose_clock, measure_minima


def test_least_takes_the_least_of_each_part_and_holds_slow_subjects_back():
    seen = {"quick": 0, "slow": 0}
    parts = {"quick": [(5.0, 1.0), (3.0, 2.0), (4.0, 0.5)], "slow": [(9.0,)]}

    def subject(name):
        def run(clock):
            seen[name] += 1
            return parts[name][(seen[name] - 1) % len(parts[name])]

        return run

    best = measure_minima({name: subject(name) for name in parts}, 0.02, choose_clock(1), {"slow": 1})
    assert seen["slow"] == 1 and seen["quick"] >= 3
    assert best == {"quick": (3.0, 0.5), "slow": (9.0,)}


def test_everything_runs_twice_whatever_the_budget():
    seen = []
    measure_minima({"a": lambda clock: (float(len(seen)), seen.append(1))[:1]}, 0.0, choose_clock(2))
    assert len(seen) == 2


def test_slow_subjects_alone_come_to_an_end():
    seen = []
    measure_minima({"a": lambda clock: (float(len(seen)), seen.append(1))[:1]}, 5.0, choose_clock(2), {"a": 3})
    assert len(seen) == 3
