"""Exposures of photographs: gains in linear light, their gauge, and cameras that took none."""

from dataclasses import replace

import pytest
import torch

from scene_experts.scene.exposure import GAMMA, Exposures
from support.scenes import CAMERA


def camera_at(id, x, turn=0.0):
    pose = CAMERA.world_to_cam.clone()
    pose[0, 3] -= x
    return replace(CAMERA, world_to_cam=pose, id=id)


@pytest.fixture
def exposures():
    made = Exposures([camera_at(i, x) for i, x in ((3, 0.0), (5, 1.0), (9, 2.0))])
    with torch.no_grad():
        made.stops.copy_(torch.tensor([[1.0, 1.0, 1.0], [0.0, 0.2, 0.0], [-0.5, -0.5, 0.1]]))
    return made


def test_a_stop_doubles_linear_light_and_white_is_the_limit(exposures):
    picture = torch.tensor([[[0.2, 0.3, 0.9]]])
    stops = exposures.stops_of(camera_at(3, 0.0))
    assert torch.allclose(stops, exposures.stops[0] - exposures.stops.mean(0))
    seen = exposures.expose(picture, camera_at(3, 0.0))
    linear, before = seen**GAMMA, picture**GAMMA
    assert torch.allclose(linear[..., :2], (before * 2**stops)[..., :2]) and float(seen.detach().max()) == 1
    assert torch.allclose(exposures.undo(seen.detach(), camera_at(3, 0.0))[..., :2], picture[..., :2])


def test_the_mean_of_the_photographs_is_the_scene(exposures):
    stops = torch.stack([exposures.stops_of(camera_at(i, 0.0)) for i in (3, 5, 9)])
    assert torch.allclose(stops.mean(0), torch.zeros(3), atol=1e-6)


def test_a_camera_without_photograph_has_the_gains_of_those_near_it():
    made = Exposures([camera_at(i, float(i)) for i in range(12)])
    with torch.no_grad():
        made.stops.copy_(torch.linspace(-1, 1, 12)[:, None].expand(12, 3))
    at = lambda x: made.stops_of(camera_at(100, x))  # noqa: E731
    weights = torch.tensor([(abs(4.5 - i) / 3) ** -2 for i in range(12)])  # 3: mean distance of the positions from their middle
    known = made.stops.detach()
    told = [sum(abs(i - j) ** -2 * float(known[j, 0]) for j in range(12) if j != i) for i in range(12)]
    told = torch.tensor(told) / torch.tensor([sum(abs(i - j) ** -2 for j in range(12) if j != i) for i in range(12)])
    trust = min(1.0, float((told * known[:, 0]).sum() / told.square().sum()))
    assert torch.allclose(at(4.5), trust * (weights @ known / weights.sum()), atol=1e-5)
    assert float(at(0.0)[0].detach()) < -0.8 and float(at(11.0)[0].detach()) > 0.8 and trust > 0.9


def test_gains_at_random_tell_nothing_about_another_camera():
    made = Exposures([camera_at(i, float(i)) for i in range(40)])
    with torch.no_grad():
        made.stops.copy_(torch.where(torch.arange(40) % 2 == 0, 1.0, -1.0)[:, None].expand(40, 3))  # neighbours tell the opposite
    assert torch.allclose(made.stops_of(camera_at(100, 7.2)), torch.zeros(3), atol=1e-6)


def test_gradients_are_those_of_finite_differences(exposures):
    made, camera = exposures.double(), camera_at(5, 1.0)
    picture = torch.rand(3, 4, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(0)) * 0.5 + 0.1
    picture.requires_grad_()

    def of_stops(stops):
        made.stops.data = stops.data
        gains = torch.exp2((stops - stops.mean(0))[1] / GAMMA)
        return picture * gains

    (made.expose(picture, camera).square().sum()).backward()
    stops = made.stops.detach().clone().requires_grad_()
    of_stops(stops).square().sum().backward()
    assert torch.allclose(made.stops.grad, stops.grad)
    assert torch.autograd.gradcheck(lambda image: made.expose(image, camera), (picture,))


def test_without_a_graph_the_gradients_are_the_same(exposures):
    camera = camera_at(5, 1.0)
    picture = torch.rand(3, 4, 3, generator=torch.Generator().manual_seed(0))
    with_graph = picture.clone().requires_grad_()
    exposures.expose(with_graph, camera).square().sum().backward()
    stops, exposures.stops.grad = exposures.stops.grad, None
    with torch.no_grad():
        exposed, go_back = exposures.expose_directly(picture, camera)
        gradient = go_back(2 * exposed)
    assert not exposed.requires_grad and torch.allclose(gradient, with_graph.grad) and torch.allclose(exposures.stops.grad, stops)


def test_above_white_only_gradients_that_darken_pass(exposures):
    picture = torch.tensor([[[0.99, 0.99, 0.5]]], requires_grad=True)
    exposures.expose(picture, camera_at(3, 0.0)).backward(torch.tensor([[[1.0, -1.0, -1.0]]]))
    assert picture.grad[0, 0, 0] > 0 and picture.grad[0, 0, 1] == 0 and picture.grad[0, 0, 2] < 0


def test_they_come_back_from_a_checkpoint(exposures):
    made = Exposures.restore(exposures.tensors())
    for camera in (camera_at(9, 0.0), camera_at(7, 0.3)):
        assert torch.equal(made.stops_of(camera), exposures.stops_of(camera))
    assert Exposures.restore({}) is None


def test_short_trainings_learn_faster(exposures):
    assert exposures.learning_rate(3000, 3000) == pytest.approx(1e-4) and exposures.learning_rate(50, 3000) < 0.006
    assert exposures.learning_rate(10, 300) == pytest.approx(0.01 * 10**0.5 * 0.01 ** (10 / 300), rel=0.05)
    assert exposures.learning_rate(30_000, 30_000) == pytest.approx(1e-4)
