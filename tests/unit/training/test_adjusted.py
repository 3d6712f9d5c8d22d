"""Refined poses start where the capture's tracks put them."""

import numpy as np
import pytest
import torch

from scene_experts.training.adjusted import adjust_to_tracks
from support.captures import load
from support.synthetic import make_capture
from support.tracks import add_tracks
from support.trainings import assert_same, config, events, last_tensors


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = make_capture(tmp_path_factory.mktemp("capture"), views=10).folder
    add_tracks(folder, turned=0.01, shifted=0.02)
    return folder


def turns(capture):
    """Rotations of the training cameras against the first."""
    R = torch.stack([capture.views[i].camera.world_to_cam[:3, :3].double() for i in capture.train])
    return R[0] @ R.transpose(1, 2)


def test_training_cameras_and_points_fit_the_tracks(folder, tmp_path):
    true, given = load(make_capture(tmp_path, views=10).folder), load(folder)
    found = adjust_to_tracks(given)
    assert "tracks: median error" in found.about and found.about.endswith("-> 0.00 px")
    assert (turns(found.capture) - turns(true)).abs().max() < 1e-5 < (turns(given) - turns(true)).abs().max()
    for index in given.test:
        assert torch.equal(found.capture.views[index].camera.world_to_cam, given.views[index].camera.world_to_cam)
    distances = [torch.pdist(of.points.xyz[:50]) for of in (true, given, found.capture)]
    scale = float((distances[0] / distances[2]).median())
    errors = (distances[0] / scale - distances[2]).abs()  # of points that two views show; others stay
    assert errors.quantile(0.9) < 1e-4 < (distances[0] - distances[1]).abs().quantile(0.5)
    assert found.capture.poses() == given.poses() and found.capture.fingerprint() == given.fingerprint()


def test_points_of_another_file_stay(folder, tmp_path):
    given = load(folder)
    cloud = tmp_path / "points.ply"
    head = "ply\nformat ascii 1.0\nelement vertex {}\nproperty double x\nproperty double y\nproperty double z\nend_header"
    xyz = given.world.to_input(given.points.xyz).numpy() + 0.01
    np.savetxt(cloud, xyz, header=head.format(len(xyz)), comments="")
    other = load(folder, points=cloud)
    found = adjust_to_tracks(other)
    assert torch.equal(found.capture.points.xyz, other.points.xyz)
    assert "tracks: median error" in found.about


def test_poses_that_fit_stay(tmp_path):
    folder = make_capture(tmp_path, views=10).folder
    assert "no tracks" in adjust_to_tracks(load(folder)).about
    add_tracks(folder)
    given = load(folder)
    found = adjust_to_tracks(given)
    assert found.capture is given and "the poses fit the capture's tracks" in found.about


def test_a_training_begins_there_and_resumes_bit_for_bit(folder, tmp_path):
    cfg = config("scaffold-gs", refine_poses=True, iterations=40)
    begun, *_ = events(cfg, folder, tmp_path / "whole", stop_at=20)
    assert "poses and points adjusted" in begun.start
    list(events(cfg, folder, tmp_path / "parts", stop_at=10))
    list(events(cfg, folder, tmp_path / "parts", stop_at=20, resume=True))
    tensors = last_tensors(tmp_path / "whole")
    assert_same(tensors, last_tensors(tmp_path / "parts"))
    assert tensors["poses.begun"].abs().max() > 1e-3


def test_tracks_of_one_photograph_each_adjust_nothing(tmp_path):
    folder = make_capture(tmp_path, views=10).folder
    given = load(folder)
    add_tracks(folder, unseen=tuple(given.views[i].name for i in given.train[1:]))
    found = adjust_to_tracks(load(folder))
    assert "no point is in the tracks of two" in found.about and "nan" not in found.about
