"""The region that photographs were taken in."""

import pytest
import torch

from scene_experts.view.region import NEAR, find_region


def test_a_place_outside_moves_to_the_nearest_point_of_the_region():
    places = torch.tensor([[0.0, 0, 0], [0.1, 0, 0], [0.2, 0, 0]])
    region = find_region(places, 2.0)
    assert region.radius == NEAR * 2.0
    inside = torch.tensor([0.2, 0.1, 0.0])
    assert torch.equal(region.nearest(inside), inside)
    assert torch.allclose(region.nearest(torch.tensor([5.2, 0.0, 0.0])), torch.tensor([0.2 + NEAR * 2, 0, 0]).double())
    for place in torch.randn(20, 3) * 4:
        moved = region.nearest(place)
        assert float((region.places - moved).norm(dim=1).min()) <= region.radius * (1 + 1e-9)


def test_neighbouring_places_are_connected():
    """A ring of few cameras far apart: nobody is stuck at one of them."""
    angle = torch.linspace(0, 2 * torch.pi, 7)[:6]
    places = torch.stack([angle.cos(), angle.sin(), torch.zeros(6)], 1)
    region = find_region(places, 1.0)
    between = (places[0] + places[1]) / 2
    assert torch.equal(region.nearest(between), between)
    assert find_region(places[:1], 1.0).radius == NEAR


def test_places_of_several_views_are_one_place():
    places = torch.tensor([[float(i), 0, 0] for i in range(5)])
    assert find_region(places.repeat_interleave(12, 0), 3.0).radius == find_region(places, 3.0).radius == 1.0
    assert find_region(places[:1].repeat(12, 1), 3.0).radius == pytest.approx(0.6)
