"""Keypoints of maps of scores whose maxima are known."""

import torch

from scene_experts.sfm.learned.keypoints import TEMPERATURE, find_keypoints, find_maxima


def bump(x: float, y: float, height: float, size: tuple[int, int] = (30, 40)) -> torch.Tensor:
    rows, columns = torch.meshgrid(torch.arange(size[0]), torch.arange(size[1]), indexing="ij")
    return height * torch.exp(-((columns - x) ** 2 + (rows - y) ** 2) / 2)


def test_maxima_between_pixels_the_largest_first():
    scores = bump(10.3, 8.2, 0.5) + bump(25.0, 20.0, 0.9) + bump(32.0, 5.0, 0.1)
    places, found = find_keypoints(scores, 10, 0.2)
    assert len(places) == 2 and (places - torch.tensor([[25.0, 20.0], [10.3, 8.2]])).abs().max() < 0.2
    assert found[0] == scores[20, 25] and found[1] == scores[8, 10]
    assert len(find_keypoints(scores, 1, 0.0)[0]) == 1 and find_keypoints(scores, 10, 0.95)[0].shape == (0, 2)


def test_the_place_is_a_weighted_mean_of_the_pixels_around():
    scores = bump(10.3, 8.2, 0.5)
    place = find_keypoints(scores, 1, 0.1)[0][0]
    total = x = y = 0.0
    for row in range(6, 11):
        for column in range(8, 13):
            weight = float(torch.exp(scores[row, column].double() / TEMPERATURE))
            total, x, y = total + weight, x + weight * column, y + weight * row
    assert abs(place[0] - x / total) < 1e-4 and abs(place[1] - y / total) < 1e-4


def test_keypoints_keep_away_from_each_other_and_from_the_border():
    places, _ = find_keypoints(torch.rand(64, 48, generator=torch.Generator().manual_seed(0)), 5000, 0.0)
    pixels = places.round()
    assert len(places) > 50 and pixels.min() >= 0 and (pixels[:, 0] <= 47).all() and (pixels[:, 1] <= 63).all()
    maxima = torch.nonzero(find_maxima(torch.rand(64, 48, generator=torch.Generator().manual_seed(0))))
    apart = (maxima[:, None] - maxima).abs().amax(-1) + 10 * torch.eye(len(maxima), dtype=torch.int64)
    assert apart.min() > 2
    assert not len(find_keypoints(bump(1.0, 8.0, 0.9), 10, 0.5)[0])  # its maximum is at the border


def test_a_maximum_beside_a_suppressed_pixel_is_found():
    scores = torch.zeros(9, 20)
    scores[4, 5], scores[4, 7], scores[4, 9] = 0.9, 0.8, 0.7  # the second is suppressed by the first, so the third counts
    assert torch.nonzero(find_maxima(scores) & (scores > 0)).tolist() == [[4, 5], [4, 9]]


def test_a_picture_smaller_than_the_border_has_none():
    assert find_keypoints(torch.rand(3, 4), 10, 0.0)[0].shape == (0, 2)
