"""The cost of iterations, against a sum over all of them."""

from dataclasses import replace

import pytest
import torch

from scene_experts.core.types import Camera
from scene_experts.training.course import GROWN, PER_MEGAPIXEL, Course, cost_of, find_course
from scene_experts.training.early import LEAST
from support.trainings import config


def camera(width: int, height: int) -> Camera:
    return Camera(torch.eye(4), torch.eye(3), width, height)


@pytest.mark.parametrize("switch", (0, 100, 500, 750, 1000))
def test_what_is_spent_is_the_sum_of_the_iterations(switch):
    course = Course(1000, GROWN, switch, 3.0)
    costs = [(1 + GROWN * min(2 * i / 1000, 1)) * (3 if i >= switch else 1) for i in range(1000)]
    for step in (0, 50, 100, 500, 501, 900, 1000):
        assert course.spent(step) == pytest.approx(sum(costs[:step]), rel=0.01)
    assert Course(1000).spent(300) == 300
    assert Course(1000, GROWN).spent(1000) / (10 * Course(1000, GROWN).spent(100)) == pytest.approx(1.37, abs=0.01)


def test_only_photographs_that_are_seen_small_make_a_difference():
    cfg = replace(config(), half_until=15_000, iterations=1000).scaled()
    small, large = camera(LEAST - 1, 450), camera(LEAST, 450)
    course = find_course(cfg, [large], cuda=False)
    assert course.switch == 500 and course.slower == pytest.approx(cost_of(0.36) / cost_of(0.09)) and 1.4 < course.slower < 1.7
    mixed = find_course(cfg, [large, small], cuda=False).slower
    assert mixed == pytest.approx((cost_of(0.36) + cost_of(0.35955)) / (cost_of(0.09) + cost_of(0.35955)))
    assert find_course(cfg, [small], cuda=False).slower == find_course(cfg, [], cuda=False).slower == 1.0
    assert find_course(replace(cfg, half_until=0), [large], cuda=False) == Course(1000, GROWN)
    assert find_course(cfg, [large], cuda=True) == Course(1000)
    assert cost_of(1.0) == 1 + PER_MEGAPIXEL
