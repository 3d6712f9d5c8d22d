"""Fixtures for the tests of the evaluation."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch

from scene_experts.evaluate import weights


@pytest.fixture
def no_weights(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """No LPIPS weights on this machine: an empty cache, an empty hub, no packages."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.setenv("LOCALAPPDATA", str(tmp_path / "cache"))
    monkeypatch.setattr(weights, "cache_dir", lambda: tmp_path / "cache" / "scene-experts")
    monkeypatch.setattr(torch.hub, "get_dir", lambda: str(tmp_path / "hub"))
    monkeypatch.setattr(weights, "find_package_folders", lambda package, *parts: [])
    monkeypatch.delenv(weights.VARIABLE, raising=False)
