"""The training that the program proposes: longer and larger where the machine is fast, never longer than the limit if that can be."""

import pytest

from scene_experts.bench import advice


def test_the_measured_picture_takes_time():
    assert 0 < advice.measure_picture() < 60


def test_twice_the_iterations_take_twice_the_time_and_threads_save_some():
    one, two = (advice.estimate_minutes(800, 600, n, 0.015, 1) for n in (1000, 2000))
    assert two == pytest.approx(2 * one)
    # 2,000 iterations x 15 ms x (5 + 9.5 x 0.48 x 0.48 / 1.08) = 210.8 s
    assert two == pytest.approx(210.8 / 60, rel=3e-3)
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


def test_half_the_size_at_first_takes_less_but_never_less_than_smaller_photographs():
    assert advice.share_of_half(0.4) == pytest.approx(0.84, abs=0.01)  # fox 0.82, banana 0.865
    assert 0.70 < advice.share_of_half(1.9) < advice.share_of_half(1.08) < 0.80
    minutes = [advice.estimate_minutes(side, side * 3 // 4, 1000, 0.015, 1) for side in (400, 600, 799, 800, 1000, 1200, 1600)]
    assert minutes == sorted(minutes)
    whole = 1000 * 0.015 * advice.cost_at(1.6 * 1.2) / 60
    assert minutes[-1] == pytest.approx(whole * advice.share_of_half(1.6 * 1.2))
