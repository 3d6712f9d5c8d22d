"""The speed that a time left is extrapolated from."""

import pytest

from scene_experts.core.progress import RECENT, Speedometer


def test_the_speed_is_that_of_the_last_seconds():
    clock, done = [100.0], 0
    pace = Speedometer(lambda: clock[0])
    assert pace(5) is None  # what was done before says nothing
    clock[0] += 1.0
    assert pace(15) is None  # too soon
    clock[0] += 1.0
    assert pace(25) == pytest.approx(10)
    done = 25
    for _ in range(40):  # slower from now on
        clock[0] += 1.0
        done += 2
        found = pace(done)
    assert RECENT < 40 and found == pytest.approx(2)
    assert pace(3) is None  # begun anew


def test_work_that_does_not_move_has_no_speed():
    clock = [0.0]
    pace = Speedometer(lambda: clock[0])
    pace(0)
    clock[0] += 10.0
    assert pace(0) is None
