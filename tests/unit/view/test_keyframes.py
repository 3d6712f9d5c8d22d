"""Keyframes: set where a client stands, saved as a path that `render` reads, played back."""

import json

import numpy as np
import pytest

from scene_experts.view import path_files
from support.viewers import joined

pytest.importorskip("viser")


def test_keyframes_become_a_path_that_render_reads(viewer, capture, tmp_path):
    handle, keys = joined(viewer), viewer.panel.keyframes
    keys.folder = tmp_path
    keys.save(None)
    assert "no keyframes" in keys.words.content and not list(tmp_path.iterdir())
    for x in (0.0, 1.0, 2.0):
        handle.camera.position = np.array([x, 0.0, 0.0])
        keys.add(handle)
    keys.save(None)
    (path,) = tmp_path.iterdir()
    assert json.loads(path.read_text())["fps"] == 24.0
    made = path_files.read_path(path, capture.world, capture.views[0].camera)
    assert len(made) == 97 and made.fps == 24.0  # two intervals of two seconds, including both ends
    assert np.allclose(made.cameras[48].position.numpy(), [1.0, 0, 0], atol=1e-4)
    sent = []
    handle.send_file_download = lambda name, data: sent.append((name, data))
    keys.save(handle)
    assert sent and json.loads(sent[0][1])["format"] == 1
    keys.clear()
    assert keys.keys == []


def test_playing_moves_the_client(viewer):
    handle, keys = joined(viewer), viewer.panel.keyframes
    keys.play(handle)
    assert keys.words.content
    for x in (0.0, 1.0):
        handle.camera.position = np.array([x, 0.0, 0.0])
        keys.add(handle)
    keys.seconds.value = 0.1
    handle.camera.position = np.array([9.0, 9.0, 9.0])
    keys.move_client(handle, fps=50.0)
    assert np.allclose(handle.camera.position, [1.0, 0, 0], atol=1e-5)


def test_a_flight_around_the_scene_is_made_of_keyframes(viewer, monkeypatch):
    handle, keys = joined(viewer), viewer.panel.keyframes
    played = []
    monkeypatch.setattr(keys, "play", played.append)
    keys.fly_around(handle)
    assert len(keys.keys) == 24 and keys.loop.value and played == [handle]
