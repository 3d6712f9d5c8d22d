"""A training in a browser: drawing keeps to its share of the time, and a paused training waits."""

import time
from types import SimpleNamespace

import pytest
import torch

from scene_experts.core.types import Camera, Mode
from scene_experts.training.recipes import RECIPES

pytest.importorskip("viser")
from scene_experts.view.live import Live
from support.viewers import DRAW, joined


def test_drawing_keeps_to_its_share_and_a_paused_training_waits(viewer, capture):
    scene, _ = viewer.current()
    training = SimpleNamespace(scene=scene, step=5)
    stop: list[str] = []
    live = Live(capture, DRAW, lambda: bool(stop), port=0, ready=lambda url: None)
    live(training)
    assert live.viewer is not None
    try:
        handle = joined(live.viewer)
        for _ in range(200):
            live.viewer.request_redraw()
            live(training)
        assert 1 <= len(handle.pictures) < 200  # most iterations draw nothing
        live.viewer.panel.pause.value = True  # type: ignore[union-attr]
        stop.append("enough")
        began = time.monotonic()
        live(training)
        assert time.monotonic() - began < 30  # it does not wait for ever
    finally:
        live.close()


def test_a_coarser_level_in_the_browser_does_not_affect_the_training(capture):
    torch.manual_seed(0)
    scene = RECIPES["octree-gs"][1].scene.start(capture.points, capture.extent, [v.camera for v in capture.views])
    live = Live(capture, DRAW, lambda: False, port=0, ready=lambda url: None)
    live(SimpleNamespace(scene=scene, step=20_000))
    assert live.viewer is not None
    try:
        handle = joined(live.viewer)
        live.viewer.draw()
        live.viewer.panel.level.value = 0  # type: ignore[union-attr]
        live.viewer.draw()
        whole, coarse = (picture for picture, _ in handle.pictures[-2:])
        assert (whole != coarse).any()  # the browser shows a coarser level
        camera: Camera = capture.views[0].camera
        assert scene.table.facts["level"][scene(camera, 20_000, Mode.TRAIN, DRAW.visible).rows].unique().numel() > 1
    finally:
        live.close()
