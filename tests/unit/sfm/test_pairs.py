"""Which photographs are matched."""

import pytest

from scene_experts.sfm import pairs


def test_all_pairs_up_to_a_number_and_features_beyond():
    most = pairs.MOST_EXHAUSTIVE
    assert len(pairs.choose_pairs(5)) == 10 and len(pairs.choose_pairs(most)) == most * (most - 1) // 2
    assert pairs.choose_pairs(most + 1) is None
    assert pairs.choose_pairs(most + 1, "exhaustive")[-1] == (most - 1, most)


@pytest.mark.parametrize("count", [1, 2, 11, 40])
def test_sequential_is_the_next_ones_and_powers_of_two(count):
    steps = {1, 2, 3, 4, 8, 16, 32}
    expected = {(i, j) for i in range(count) for j in range(i + 1, count) if j - i in steps}
    assert set(pairs.choose_pairs(count, "sequential", neighbours=3)) == expected


def test_photographs_are_matched_with_those_like_them_and_with_the_next_ones(monkeypatch):
    ranks = [[(i + step) % 50 for step in (25, 24, *range(1, 24), *range(26, 31))] for i in range(50)]
    monkeypatch.setattr(pairs, "describe_photos", lambda database, names: names)
    monkeypatch.setattr(pairs, "rank_alike", lambda vectors, count: ranks)
    monkeypatch.setattr(pairs, "read_positions", lambda database, names: None)
    monkeypatch.setattr(pairs, "find_near", lambda positions, count: [(3, 44)])
    near, spare = pairs.find_alike(None, ["photo"] * 50)
    assert {(0, 25), (0, 24), (0, 1), (0, 2), (0, 3), (3, 44), (48, 49)} <= set(near) and (0, 12) in spare
    assert near == sorted(set(near)) and not set(near) & set(spare) and all(i < j for i, j in [*near, *spare])
    assert len(near) <= 50 * (pairs.ALIKE + pairs.FOLLOWING) + 1


def test_frames_of_a_video_are_matched_with_some_far_ahead_too(monkeypatch):
    ranks = [[j for j in (i - 1, i + 1, i + 2) if 0 <= j < 50] for i in range(50)]
    monkeypatch.setattr(pairs, "describe_photos", lambda database, names: names)
    monkeypatch.setattr(pairs, "rank_alike", lambda vectors, count: ranks)
    monkeypatch.setattr(pairs, "read_positions", lambda database, names: None)
    monkeypatch.setattr(pairs, "find_near", lambda positions, count: [])
    (photos, _), (film, _) = (pairs.find_alike(None, ["frame"] * 50, film=film) for film in (False, True))
    more = set(film) - set(photos)
    assert set(photos) < set(film) and {j - i for i, j in more} <= {8, 16, 32} and {(10, 18), (10, 26), (10, 42)} <= set(film)


def test_photographs_of_one_place_are_not_matched(monkeypatch):
    ranks = [[(i + step) % 40 for step in range(1, 40)] for i in range(40)]
    asked = []
    monkeypatch.setattr(pairs, "describe_photos", lambda database, names: names)
    monkeypatch.setattr(pairs, "rank_alike", lambda vectors, count: asked.append(count) or [row[:count] for row in ranks])
    monkeypatch.setattr(pairs, "read_positions", lambda database, names: None)
    monkeypatch.setattr(pairs, "find_near", lambda positions, count: [])
    near, spare = pairs.find_alike(None, ["view"] * 40, [str(i // 4) for i in range(40)])
    assert asked == [pairs.ALIKE + pairs.SPARE + 3] and all(i // 4 != j // 4 for i, j in [*near, *spare])
    assert {(0, 4), (0, 13), (3, 4), (3, 6)} <= set(near)
