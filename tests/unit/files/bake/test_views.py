"""The cameras of a bake: training views and what lies between neighbours, never a held-out view."""

from dataclasses import replace

import pytest
import torch

from scene_experts.core.errors import InputError
from scene_experts.files.bake import views as bake_views
from scene_experts.files.bake.views import NEIGHBOURS, Views, neighbours
from scene_experts.geometry.poses import FREE
from support.captures import load
from support.synthetic import make_capture


@pytest.fixture(scope="module")
def capture(tmp_path_factory):
    found = load(make_capture(tmp_path_factory.mktemp("capture"), views=12, size=(48, 32), points=200).folder)
    found.images.close()
    return found


def test_neighbours_are_near_and_look_the_same_way():
    positions = torch.tensor([[0.0, 0, 0], [1, 0, 0], [2, 0, 0], [0.1, 0, 0]], dtype=torch.float64)
    ahead = torch.tensor([[0.0, 0, 1], [0, 0, 1], [0, 0, 1], [0, 0, -1]], dtype=torch.float64)
    found = neighbours(positions, ahead, 1.0, 2)
    assert found[0].tolist() == [1, 2]  # the fourth is nearest, but looks the other way
    assert neighbours(positions[:1], ahead[:1], 1.0).shape == (1, 0)


def test_free_views_lie_among_their_views_and_keep_the_lens(capture, monkeypatch):
    monkeypatch.setattr(bake_views, "BEYOND", 0.0)
    views = Views.of(capture)
    assert len(views) == len(capture.train) and views.near.shape == (len(views), min(NEIGHBOURS, len(views) - 1))
    generator = torch.Generator().manual_seed(1)
    near = views.near.tolist()
    three = [views.positions[[i, j, k]] for i in range(len(views)) for j in near[i] for k in near[i] if j != k]
    for _ in range(20):
        camera = views.free(generator)
        place = torch.cat([camera.position.double(), torch.ones(1).double()])
        shares = [torch.linalg.lstsq(torch.cat([p.T, torch.ones(1, 3).double()]), place[:, None]) for p in three]
        off = [
            float((torch.cat([p.T, torch.ones(1, 3).double()]) @ s.solution - place[:, None]).norm() - s.solution.clamp_max(0).sum())
            for p, s in zip(three, shares)
        ]
        assert min(off) < 1e-4 and camera.id == FREE and camera.width in {c.width for c in views.cameras}
        R = camera.world_to_cam[:3, :3]
        torch.testing.assert_close(R @ R.T, torch.eye(3), atol=1e-5, rtol=0)


def test_sums_go_over_the_training_views_and_free_ones(capture, monkeypatch):
    views, generator = Views.of(capture), torch.Generator().manual_seed(0)
    found = views.for_sums(generator)
    assert len(found) == bake_views.LEAST_VIEWS and found[: len(views)] == list(views.cameras)
    held_out = [capture.views[i].camera.position for i in capture.test]
    for camera in found:
        assert min(float((camera.position - p).norm()) for p in held_out) > 1e-4
    monkeypatch.setattr(bake_views, "LEAST_VIEWS", 0)
    monkeypatch.setattr(bake_views, "MOST_TRAINING", 4)
    assert len(views.for_sums(generator)) == 5
    alone = Views.of(replace(capture, train=capture.train[:1]))
    torch.testing.assert_close(alone.free(generator).world_to_cam, alone.cameras[0].world_to_cam)


def test_a_capture_without_training_views_is_refused(capture):
    with pytest.raises(InputError, match="--split"):
        Views.of(replace(capture, train=()))
