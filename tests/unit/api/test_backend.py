"""The choice of device and rasteriser."""

import pytest
import torch

from scene_experts.api import backend as module
from scene_experts.api.backend import OwnState, backend, device_of
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
    with OwnState("cpu", True)():
        assert torch.are_deterministic_algorithms_enabled()
    assert torch.are_deterministic_algorithms_enabled() == before
    with OwnState("cpu", False)():
        assert torch.are_deterministic_algorithms_enabled() == before


def test_random_numbers_are_apart_from_those_of_the_caller():
    torch.manual_seed(3)
    expected, alone = torch.rand(2), torch.Generator().manual_seed(5)
    torch.manual_seed(3)
    own, found = OwnState("cpu", False), []
    with own():
        torch.manual_seed(5)
        found.append(torch.rand(4))
    assert torch.equal(torch.rand(2), expected)
    with pytest.raises(KeyError), own():  # also after an error
        found.append(torch.rand(4))
        raise KeyError
    with own():
        found.append(torch.rand(4))
    assert all(torch.equal(numbers, torch.rand(4, generator=alone)) for numbers in found)
