"""Fixtures of a running viewer, and a stand-in for a viser client."""

import threading
from contextlib import contextmanager
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from scene_experts.render import choose
from scene_experts.training.recipes import RECIPES
from support.captures import load
from support.synthetic import make_capture

DRAW = choose("auto", "cpu")


class Handle:
    """The part of a viser client that the viewer uses."""

    def __init__(self, number=0):
        self.client_id, self.pictures, self.update = number, [], None
        self.camera = SimpleNamespace(
            wxyz=np.array([1.0, 0, 0, 0]), position=np.zeros(3), fov=0.8, aspect=1.5, image_height=60, on_update=self.keep, look_at=None
        )
        self.scene = SimpleNamespace(set_background_image=lambda picture, **how: self.pictures.append((picture, how)))

    def keep(self, function):
        self.update = function

    @contextmanager
    def atomic(self):
        yield

    def move(self):
        self.update(None)  # type: ignore[misc]


@pytest.fixture(scope="module")
def capture(tmp_path_factory):
    """A small capture of nine views."""
    capture = load(make_capture(tmp_path_factory.mktemp("capture"), views=9).folder)
    yield capture
    capture.images.close()


@pytest.fixture
def viewer(capture):
    """A viewer of an untrained scene on a free port, not yet serving."""
    torch.manual_seed(0)
    scene = RECIPES["moe-gs"][1].scene.start(capture.points, capture.extent)
    pytest.importorskip("viser")
    from scene_experts.view.server import Viewer

    made = Viewer(capture, lambda: (scene, 2000), DRAW, port=0)
    yield made
    made.close()


@pytest.fixture
def serving(viewer):
    """The viewer, serving in a thread of its own."""
    stop = threading.Event()
    thread = threading.Thread(target=viewer.serve, args=(stop.is_set,), daemon=True)
    thread.start()
    yield viewer
    stop.set()
    thread.join(10)


def joined(viewer, number=0) -> Handle:
    """Connect a client that gets its full picture immediately."""
    handle = Handle(number)
    viewer.connect(handle)
    viewer.clients[number].moved = viewer.clients[number].arriving = 0.0
    return handle
