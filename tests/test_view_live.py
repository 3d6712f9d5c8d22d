"""A training in a browser: drawing keeps to its share of the time, and a paused training waits."""

import time
from types import SimpleNamespace

import pytest

pytest.importorskip("viser")
from scene_experts.view.live import Live
from test_view_server import DRAW, capture, joined, viewer  # noqa: F401


def test_a_training_is_shown_within_its_share_and_held_while_paused(viewer, capture):  # noqa: F811
    scene, _ = viewer.current()
    training = SimpleNamespace(scene=scene, step=5)
    stop: list[str] = []
    live = Live(capture, DRAW, lambda: bool(stop), port=0, ready=lambda url: None)
    live(training)
    assert live.viewer is not None
    try:
        handle = joined(live.viewer)
        for _ in range(200):
            live.viewer.touch()
            live(training)
        assert 1 <= len(handle.pictures) < 200  # most iterations are left alone
        live.viewer.panel.pause.value = True  # type: ignore[union-attr]
        stop.append("enough")
        began = time.monotonic()
        live(training)
        assert time.monotonic() - began < 2
    finally:
        live.close()
