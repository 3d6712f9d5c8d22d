"""The choice of device and rasteriser."""

import pytest
import torch

from scene_experts.api import backend as module
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


def test_auto_takes_cuda_only_with_a_fast_rasteriser(monkeypatch):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(module, "explain_missing", lambda: None)
    assert device_of("auto") == "cuda" and device_of("auto", "cpu") == "cpu"
    monkeypatch.setattr(module, "explain_missing", lambda: "gsplat is missing: run `pip install gsplat`")
    module._warn.cache_clear()
    with pytest.warns(UserWarning, match="pip install gsplat"):
        assert device_of("auto") == "cpu"
    module._warn.cache_clear()
    assert device_of("auto", "reference") == "cuda", "the user asked for it"
    assert device_of("auto", "gsplat") == "cuda", "gsplat then says what is missing"


def test_deterministic_algorithms_end_with_their_block():
    before = torch.are_deterministic_algorithms_enabled()
    with deterministic(True):
        assert torch.are_deterministic_algorithms_enabled()
    assert torch.are_deterministic_algorithms_enabled() == before
    with deterministic(False):
        assert torch.are_deterministic_algorithms_enabled() == before
