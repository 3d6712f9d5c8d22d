"""`eval` opens the run that it is given and evaluates it with the settings of the run."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from scene_experts.core.errors import InputError
from scene_experts.data.settings import Data
from scene_experts.evaluate import command
from scene_experts.evaluate.options import EvalOptions
from scene_experts.training.clock import Clock
from scene_experts.training.config import RunConfig
from scene_experts.training.recipes import RECIPES


@dataclass(frozen=True)
class Raster:
    antialias: bool = False


@pytest.mark.parametrize("antialias", [False, True])
def test_evaluates_what_the_run_says(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, antialias: bool) -> None:
    cfg = replace(RECIPES["moe-gs"][1], iterations=300, seed=4, antialias=antialias)
    config = RunConfig(cfg, Data(Path("old"), split="mod:4"), versions={"torch": "x"})
    closed: list[bool] = []
    seen: dict[str, Any] = {}
    scene = SimpleNamespace(poses=None)
    opened = SimpleNamespace(
        config=config, scene=scene, step=250, clock=Clock(9.0, 17.0, {"cores": 2}), capture="a", poses="four", path=tmp_path, cameras=None
    )
    capture = SimpleNamespace(
        root="new",
        fingerprint=lambda: "a",
        expect_poses=lambda poses, run: seen.update(poses=(poses, run)),
        images=SimpleNamespace(close=lambda: closed.append(True)),
    )

    def load(data: Data, seed: int) -> Any:
        seen["data"] = data
        return capture

    def evaluate(*args: Any, **options: Any) -> dict[str, Any]:
        seen.update(args=args, **options)
        options["progress"]("rendering and scoring", 1, 2)
        return {"psnr": 1.0}

    monkeypatch.setattr(command.run_folder, "open_run", lambda run, device, step: opened)
    monkeypatch.setattr(command.run_folder.captures, "load", load)
    monkeypatch.setattr(command, "evaluate", evaluate)
    result = command.evaluate_run(tmp_path, "cpu", Raster(), EvalOptions("train", lpips=False), data=Path("new"))  # type: ignore[arg-type]
    assert result == {"psnr": 1.0} and closed == [True]
    assert seen["data"] == Data(Path("new"), split="mod:4")
    assert seen["args"] == (scene, capture, Raster(antialias), tmp_path, EvalOptions("train", lpips=False))
    assert seen["step"] == 250 and seen["poses"] == ("four", tmp_path)
    about = seen["about"]
    assert (about.recipe, about.iterations, about.seed, about.versions) == ("moe-gs", 300, 4, {"torch": "x"})
    assert (about.train_seconds, about.cpu_seconds, about.load) == (9.0, 17.0, {"cores": 2})
    opened.capture = "b"
    with pytest.raises(InputError, match="new"):
        command.evaluate_run(tmp_path, "cpu", Raster(), EvalOptions(), data=Path("new"))  # type: ignore[arg-type]
