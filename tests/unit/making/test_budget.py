"""How the minutes of a call are divided, and what is told about the time left."""

import pytest

from scene_experts.bench import advice
from scene_experts.making.budget import (
    FIRST,
    LEAST,
    LEAST_PAGE,
    MOST,
    MOST_OF_FEW,
    TimeBudget,
    Whole,
    find_slowness,
    plan_training,
)
from scene_experts.training.course import GROWN, Course


class Clock:
    def __init__(self):
        self.time = 100.0

    def __call__(self):
        return self.time


def test_the_training_gets_what_page_and_scores_leave():
    clock = Clock()
    budget = TimeBudget(600.0, clock)
    clock.time += 100.0
    assert budget.left == pytest.approx(500) and budget.for_training(0) == pytest.approx(485)
    assert budget.for_training(2) == pytest.approx(468) and budget.for_training(1000) == pytest.approx(410)
    clock.time += 480.0
    assert budget.for_training(0) == pytest.approx(20 - LEAST_PAGE)
    clock.time += 1000.0
    assert budget.left == 0 and budget.for_training(2) == 0
    free = TimeBudget(None, clock)
    assert free.left is None and free.for_training(2) is None


def test_a_training_fills_the_time_that_it_has(monkeypatch):
    monkeypatch.setattr(advice, "recall_picture", lambda: 0.015)
    monkeypatch.setattr(advice.gsplat_install, "is_likely", lambda: False)
    short, long = plan_training(1200, 800, 40, 60.0), plan_training(1200, 800, 40, 3600.0)
    assert short.minutes == pytest.approx(1.0, rel=0.01) and long.minutes == pytest.approx(60.0, rel=0.01)
    assert 0 < short.side < 1200 and long.side == 0 and long.iterations > short.iterations
    slow = plan_training(1200, 800, 40, 600.0, slow=4.0)
    assert slow == plan_training(1200, 800, 40, 150.0)
    assert plan_training(1200, 800, 40, 0.0).iterations == LEAST and plan_training(1200, 800, 40, 1e9).iterations == MOST
    assert plan_training(1200, 800, 12, 1e9).iterations == MOST_OF_FEW
    for views in (12, 40):
        first, proposed = plan_training(1200, 800, views, None), advice.suggest(1200, 800, views)
        assert first.iterations == FIRST * proposed.iterations and first.side == proposed.side
        assert first.minutes == pytest.approx(FIRST * proposed.minutes)


def test_how_slow_the_machine_is_follows_from_the_first_iterations():
    """400 iterations, of which the first 40 took 4 s: all take 54.7 s."""
    course, fits = Course(400, GROWN), 54.7
    assert find_slowness(course, 40, 4.0, 1.0, fits) is None and find_slowness(course, 40, 4.0, 1.0, 1.1 * fits) is None
    assert find_slowness(course, 40, 4.0, fits / 60 / 3, fits / 2) == pytest.approx(3, rel=0.01)
    assert find_slowness(course, 40, 4.0, None, fits / 2) == pytest.approx(2, rel=0.01)
    assert find_slowness(course, 40, 4.0, 1.0, 3 * fits) is not None
    # with photographs at half their size until half of it, and iterations that take 3 times as long from there
    course = Course(400, GROWN, 200, 3.0)
    assert find_slowness(course, 40, 4.0, None, 115.1) is None
    assert find_slowness(course, 40, 4.0, None, 115.1 / 2) == pytest.approx(2, rel=0.01)


def test_on_cuda_the_iterations_follow_from_the_measured_speed(monkeypatch):
    monkeypatch.setattr(advice.gsplat_install, "is_likely", lambda: True)
    proposed = plan_training(1200, 800, 40, None)
    assert proposed.minutes is None and plan_training(1200, 800, 40, 600.0).iterations == proposed.iterations
    assert plan_training(1200, 800, 40, 600.0, slow=4.0).iterations == round(proposed.iterations / 4)


def test_the_time_left_is_that_of_the_stage_and_of_those_after_it():
    clock, told = Clock(), []
    whole = Whole(lambda *what: told.append(what), clock)
    whole.later = 120.0
    whole("features", 0, 40)
    clock.time += 10.0
    whole("features", 10, 40)
    assert told[0] == ("features", 0, 40) and told[1] == ("features (about 2:30 left in all)", 10, 40)
    whole("matches", 30, 40)  # a stage that goes on: what was done before says nothing of its speed
    clock.time += 5.0
    whole.later = 0.0
    whole("matches", 35, 40)
    assert told[2][0] == "matches" and told[3][0] == "matches (about 0:05 left in all)"
