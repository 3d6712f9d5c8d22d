"""The clock of an evaluation, on a scene that only waits."""

from __future__ import annotations

import time
from types import SimpleNamespace
from typing import Any

import pytest
import torch

from scene_experts.evaluate import timing


class Slow:
    """A scene and a rasteriser that take known times."""

    def __init__(self, decode: float, raster: float) -> None:
        self.decode, self.raster, self.drawn = decode, raster, []

    def scene(self, camera: int, step: int, training: bool, cull: Any) -> SimpleNamespace:
        time.sleep(self.decode)
        assert not training
        return SimpleNamespace(gaussians=None)

    def __call__(self, gaussians: Any, camera: int, background: torch.Tensor) -> None:
        self.drawn.append(camera)
        time.sleep(self.raster)

    def visible(self, *_: Any) -> None: ...


def test_parts_and_frames_per_second() -> None:
    slow = Slow(0.002, 0.006)
    speed = timing.measure(slow.scene, [1, 2, 3], 7, slow, torch.zeros(3))  # type: ignore[arg-type]
    assert speed.decode_ms == pytest.approx(2, abs=1.5) and speed.raster_ms == pytest.approx(6, abs=2.5)
    assert speed.fps == pytest.approx(1e3 / (speed.decode_ms + speed.raster_ms), rel=0.2)
    assert speed.frames == 10 and slow.drawn[:4] == [1, 2, 3, 1] and speed.device == "cpu"


def test_budget_and_choice_of_views() -> None:
    slow = Slow(0.0, 0.005)
    speed = timing.measure(slow.scene, list(range(100)), 7, slow, torch.zeros(3), budget=0.0)  # type: ignore[arg-type]
    assert speed.frames == 3
    slow = Slow(0.0, 0.0)
    assert timing.measure(slow.scene, list(range(100)), 7, slow, torch.zeros(3)).frames <= timing.MOST_VIEWS  # type: ignore[arg-type]
    assert set(slow.drawn) == set(range(0, 100, 4))
