import math

import pytest

from scene_experts.core.fields import scale
from scene_experts.core.schedule import Every, Rate, passes


def test_adjustments_of_scaffold_gs_run_from_1600_to_14900():
    due = [i for i in range(1, 30_001) if Every(1500, 15_000, 100).due(i)]
    assert due[0] == 1600 and due[-1] == 14_900 and len(due) == 134


def test_a_shorter_training_scales_the_window_and_keeps_the_interval():
    for every in (Every(1500, 15_000, 100), Every(350, 3500, 100), Every(0, 10, 3)):
        for last in (0, 9, 10, 1600, 3000, 30_000):
            assert every.count(last) == sum(every.due(i) for i in range(1, last + 1))
    assert scale(Every(1500, 15_000, 100), 0.1) == Every(150, 1500, 100)


@pytest.mark.parametrize(
    ("rate", "expected"), [(Rate(0.01, 0.0001), 1.0e-3), (Rate(0.002, 0.00002), 2.0e-4), (Rate(0.008, 0.00005), 6.3246e-4)]
)
def test_rates_half_way(rate, expected):
    assert rate.at(15_000, 30_000) == pytest.approx(expected, rel=1e-4)


def test_ends_zero_and_clipping():
    rate = Rate(0.01, 0.0001)
    assert rate.at(0, 100) == pytest.approx(0.01) and rate.at(100, 100) == pytest.approx(0.0001)
    assert rate.at(1000, 100) == rate.at(100, 100)
    assert Rate(0.0, 0.0).at(5, 10) == 0.0 and Rate(0.004, 0.004).at(7, 10) == 0.004
    assert rate.times(2).at(30, 100) == pytest.approx(2 * math.exp(0.7 * math.log(0.01) + 0.3 * math.log(0.0001)))


def test_a_batch_passes_the_multiples_of_its_views():
    assert [step for step in range(4, 41, 4) if passes(step, 4, 10)] == [12, 20, 32, 40]
    assert all(passes(step, 1, 7) == (step % 7 == 0) for step in range(1, 50))
