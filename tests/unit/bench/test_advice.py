"""The training that the program proposes: longer and larger where the machine is fast, never longer than the limit if that can be."""

import pytest

from scene_experts.bench import advice


def test_the_measured_picture_takes_time():
    assert 0 < advice.measure_picture() < 60


def test_twice_the_iterations_take_twice_the_time_and_threads_save_some():
    one, two = (advice.estimate_minutes(800, 600, n, 0.015, 1) for n in (1000, 2000))
    assert two == pytest.approx(2 * one)
    # 2,000 iterations x 15 ms x (5 + 9.5 x 0.48 x 0.48 / 1.08) = 210.8 s, the first half at half the size
    assert two == pytest.approx(210.8 / 60 * (0.65 / 1.973 + 0.8) / 1.45, rel=1e-3)
    assert advice.estimate_minutes(800, 600, 1000, 0.015, 2) == pytest.approx(one * (0.15 + 0.85 / 2))


def test_a_fast_machine_gets_the_whole_photographs_and_a_slow_one_the_shortest_training():
    fast, slow = (advice.suggest(1200, 800, 100, picture) for picture in (1e-4, 10.0))
    assert fast.flags == ["--iterations", "7000"] and fast.minutes < advice.LIMIT
    assert slow.flags == ["--resolution", "longest:400", "--iterations", "2000"] and slow.minutes > advice.LIMIT


def test_small_photographs_are_never_enlarged():
    found = advice.suggest(320, 240, 100, 0.5)
    assert found.side == 0 and "--resolution" not in found.flags


def test_the_time_is_that_of_pictures_of_at_most_1600_pixels_of_width():
    upright, level = (advice.suggest(*size, 100, 1e-4) for size in ((3000, 4000), (4000, 3000)))
    assert upright.side == level.side == 0 and upright.minutes > 1.5 * level.minutes


def test_few_photographs_get_a_shorter_training():
    assert advice.suggest(1200, 800, 30, 1e-4).iterations == 4000 and advice.suggest(1200, 800, 31, 1e-4).iterations == 7000


@pytest.mark.parametrize("picture", [1e-3, 1e-2, 0.03, 0.1])
def test_the_time_is_below_the_limit_where_that_can_be(picture):
    found = advice.suggest(4000, 3000, 100, picture)
    assert found.minutes <= advice.LIMIT or found.flags == advice.suggest(4000, 3000, 100, 10.0).flags


def test_a_busy_machine_is_told_with_its_share():
    found = advice.Advice(800, 4000, 6.0)
    assert found.tell(1.0) == "about 6 min on this machine"
    assert "about 15 min beside" in found.tell(0.4) and "about 6 min alone" in found.tell(0.4)
    assert advice.Advice(0, 30_000, None).tell(0.5) == ""
    assert advice.Advice(800, 300, 0.52).tell(0.5) == "about 60 s beside what else this machine does now (about 30 s alone)"


def test_half_of_a_training_on_large_photographs_counts_as_one_on_smaller_ones():
    """Below 800 px as ever; above, the first half (0.65 of 1.45) takes as many times less as its
    iterations are faster."""
    seconds = [advice.estimate_minutes(side, 600, 1000, 0.015, 1) for side in (799, 800)]
    whole = [advice.BASE + advice.PER_MEGAPIXEL * (side * 600 / 1e6) ** 2 / advice.MEASURED for side in (799, 800)]
    slower = advice.slow_down(800, 600)
    assert seconds[1] / whole[1] * whole[0] / seconds[0] == pytest.approx((0.65 / slower + 0.8) / 1.45) and 1.5 < slower < 2.5
