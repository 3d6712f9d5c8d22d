"""The speed measurement, with a scene that only waits."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest
import torch

from scene_experts.core.types import Mode
from scene_experts.evaluate import timing


class Waits:
    """A scene whose frozen form is itself."""

    def __init__(self, slow: Slow) -> None:
        self.slow = slow

    def frozen(self, step: int) -> Waits:
        return self

    def __call__(self, *args: Any) -> SimpleNamespace:
        return self.slow.decoded(*args)


class Slow:
    """A scene and a rasteriser with known times on a simulated clock, so that a busy machine has no effect."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, decode: float, raster: float) -> None:
        self.decode, self.raster, self.drawn, self.now = decode, raster, [], 0.0
        monkeypatch.setattr(timing, "time", SimpleNamespace(perf_counter=lambda: self.now))
        self.scene = Waits(self)

    def decoded(self, camera: int, step: int, mode: Mode, cull: Any) -> SimpleNamespace:
        self.now += self.decode
        assert mode is Mode.DRAW
        return SimpleNamespace(gaussians=None)

    def __call__(self, gaussians: Any, camera: int, background: torch.Tensor) -> None:
        self.drawn.append(camera)
        self.now += self.raster

    def visible(self, *_: Any) -> None: ...


def test_parts_and_frames_per_second(monkeypatch: pytest.MonkeyPatch) -> None:
    slow = Slow(monkeypatch, 0.002, 0.006)
    speed = timing.measure_speed(slow.scene, [1, 2, 3], 7, slow, torch.zeros(3))  # type: ignore[arg-type]
    assert speed.decode_ms == pytest.approx(2) and speed.raster_ms == pytest.approx(6) and speed.fps == pytest.approx(125)
    assert speed.ordinary_decode_ms == pytest.approx(2) and speed.ordinary_fps == pytest.approx(125)  # this scene is not frozen
    assert speed.frames == 10 and slow.drawn[:4] == [1, 2, 3, 1] and speed.device == "cpu"


def test_budget_and_choice_of_views(monkeypatch: pytest.MonkeyPatch) -> None:
    slow = Slow(monkeypatch, 0.0, 0.005)
    speed = timing.measure_speed(slow.scene, list(range(100)), 7, slow, torch.zeros(3), budget=0.0)  # type: ignore[arg-type]
    assert speed.frames == 3
    slow = Slow(monkeypatch, 0.001, 0.001)
    assert timing.measure_speed(slow.scene, list(range(100)), 7, slow, torch.zeros(3)).frames <= timing.MOST_VIEWS  # type: ignore[arg-type]
    assert set(slow.drawn) == set(range(0, 100, 4))
