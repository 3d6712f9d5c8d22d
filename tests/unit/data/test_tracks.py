"""Tracks: what views show of the points of a reconstruction."""

import numpy as np
import pytest

from scene_experts.data.tracks import read_tracks
from scene_experts.geometry.bundle import find_errors
from support.captures import load
from support.synthetic import make_capture
from support.tracks import add_tracks


def errors_of(capture):
    points, seen = read_tracks(capture, capture.train)
    poses = np.stack([capture.views[i].camera.world_to_cam.double().numpy() for i in capture.train])
    return np.abs(find_errors(poses, points, seen)), seen


@pytest.mark.parametrize("settings", [{}, {"resolution": "longest:24"}, {"max_views": 6}])
def test_tracks_fit_the_cameras_of_the_trained_world(tmp_path, settings):
    folder = make_capture(tmp_path, views=10).folder
    add_tracks(folder)
    errors, seen = errors_of(load(folder, **settings))
    assert len(seen) > 100 and errors.max() < 1e-3
    assert set(seen.view) == set(range(len(load(folder, **settings).train)))


def test_a_photograph_without_observations_has_none(tmp_path):
    folder = make_capture(tmp_path, views=10).folder
    capture = load(folder)
    add_tracks(folder, unseen=(capture.views[capture.train[0]].name,))
    _, seen = errors_of(capture)
    assert 0 not in seen.view and 1 in seen.view


def test_a_reconstruction_without_tracks_has_none(tmp_path):
    capture = load(make_capture(tmp_path, views=10).folder)
    assert capture.model is not None and read_tracks(capture, capture.train) is None
