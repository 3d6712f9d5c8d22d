"""Keyframes: set where a client stands, saved as a path that `render` reads, played back."""

import json
import threading
import time

import numpy as np
import pytest

from scene_experts.view import path_files
from support.viewers import joined

pytest.importorskip("viser")
from scene_experts.view.keyframes import Flight


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
    keys.folder = path  # a file: nothing can be written there
    keys.save(handle)
    assert len(sent) == 2 and sent[1][1] == sent[0][1] and "browser only" in keys.words.content
    keys.save(None)
    assert "not saved" in keys.words.content
    keys.clear()
    assert keys.keys == []


def test_playing_moves_the_client(viewer):
    handle, keys = joined(viewer), viewer.panel.keyframes
    keys.play(handle)
    assert keys.words.content
    for x in (0.0, 1.0):
        handle.camera.position = np.array([x, 0.0, 0.0])
        keys.add(handle)
    handle.camera.position = np.array([9.0, 9.0, 9.0])
    flight = keys.playing[0] = Flight(tuple(keys.keys), loop=False, seconds=0.1)
    keys.move_client(handle, flight, fps=50.0)
    assert np.allclose(handle.camera.position, [1.0, 0, 0], atol=1e-5) and not keys.playing


def test_a_flight_whose_client_fails_is_over(viewer):
    handle, keys = joined(viewer), viewer.panel.keyframes
    camera = viewer.capture.views[0].camera
    flight = keys.playing[0] = Flight((camera, camera), loop=False, seconds=0.1)
    handle.atomic = None
    with pytest.raises(TypeError):
        keys.move_client(handle, flight)
    assert not keys.playing


def test_a_flight_around_the_scene_leaves_the_keyframes(viewer, monkeypatch):
    handle, keys = joined(viewer), viewer.panel.keyframes
    flown = []
    monkeypatch.setattr(keys, "move_client", lambda *what: flown.append(what))
    keys.add(handle)
    keys.fly_around(handle)
    keys.fly_around(None)
    wait(lambda: flown)
    assert len(keys.keys) == 1 and not keys.loop.value
    ((who, flight),) = flown
    assert who is handle and len(flight.keys) == 24 and flight.loop and flight.seconds * 24 == 16.0


@pytest.mark.parametrize("end", ["fly", "play", "clear", "view", "leave"])
def test_a_flight_can_be_stopped(viewer, end):
    handle, keys = joined(viewer), viewer.panel.keyframes
    for x in (0.0, 1.0):
        handle.camera.position = np.array([x, 0.0, 0.0])
        keys.add(handle)
    keys.fly_around(handle)
    wait(lambda: keys.playing)
    if end == "fly":
        keys.fly_around(handle)
    elif end == "play":
        keys.play(handle)
    elif end == "clear":
        keys.clear()
    elif end == "view":
        viewer.go_to_view(1)
    else:
        viewer.disconnect(handle)
    assert not keys.playing
    wait(lambda: not [thread for thread in threading.enumerate() if "move_client" in thread.name])


def wait(until) -> None:
    end = time.monotonic() + 60
    while not until():
        assert time.monotonic() < end
        time.sleep(0.01)
