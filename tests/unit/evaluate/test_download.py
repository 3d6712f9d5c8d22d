"""The LPIPS weights from a server on this machine."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch

from scene_experts.evaluate import download, weights
from support.lpips import TENSORS, publish, write_torch
from support.web import serving

pytestmark = pytest.mark.usefixtures("no_weights")


def test_lpips(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    backbone, linear = write_torch(tmp_path / "published")
    publish(monkeypatch, weights.BACKBONE, backbone)
    publish(monkeypatch, weights.LINEAR, linear)
    with serving() as server:
        server.files = {f"/models/{backbone.name}": backbone.read_bytes(), f"/linear/{linear.name}": linear.read_bytes()}
        download.lpips("alex", backbones=f"{server.url}/models", linears=f"{server.url}/linear")
    tensors, source = weights.load("alex")
    assert source.startswith("cache ") and torch.equal(tensors["lin0"], TENSORS["lin0"])
    assert not (weights.cache_dir() / backbone.name).exists()  # only what is needed is kept
