"""The choice of device and rasteriser."""

import pytest
import torch

from scene_experts.api.backend import backend, deterministic, device_of
from scene_experts.core.errors import InputError


def test_the_device_and_rasteriser_that_were_asked_for(monkeypatch):
    device, rasterize = backend("cpu", "reference", True, False)
    assert device == "cpu" and rasterize.name == "reference" and rasterize.antialias  # type: ignore[attr-defined]
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    assert backend("auto", "reference", False, False)[0] == "cpu"
    with pytest.raises(InputError, match="CUDA"):
        backend("cuda", "auto", False, False)
    with pytest.raises(InputError, match="'gpu'"):
        device_of("gpu")


def test_deterministic_algorithms_end_with_their_block():
    before = torch.are_deterministic_algorithms_enabled()
    with deterministic(True):
        assert torch.are_deterministic_algorithms_enabled()
    assert torch.are_deterministic_algorithms_enabled() == before
    with deterministic(False):
        assert torch.are_deterministic_algorithms_enabled() == before
