"""The Morton order is a permutation in which neighbours in the file are neighbours in space."""

import torch

from scene_experts.files.formats.sort import morton_order


def test_a_permutation_of_near_neighbours():
    xyz = torch.rand(4000, 3, generator=torch.Generator().manual_seed(0)) * 100 - 30
    order = morton_order(xyz)
    assert order.sort().values.tolist() == list(range(4000))
    step = lambda rows: (rows[1:] - rows[:-1]).norm(dim=1).mean()  # noqa: E731
    assert step(xyz[order]) < 0.25 * step(xyz)


def test_none_one_and_equal_places():
    assert morton_order(torch.zeros(0, 3)).tolist() == [] and morton_order(torch.ones(1, 3)).tolist() == [0]
    assert morton_order(torch.ones(5, 3)).tolist() == [0, 1, 2, 3, 4]
