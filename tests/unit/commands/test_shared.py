"""The choice of device and rasteriser."""

import pytest
import torch

from scene_experts.commands.shared import backend
from scene_experts.core.errors import InputError


def test_the_device_and_rasteriser_that_were_asked_for(monkeypatch):
    device, rasterize = backend("cpu", "reference", True, False)
    assert device == "cpu" and rasterize.name == "reference" and rasterize.antialias  # type: ignore[attr-defined]
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    assert backend("auto", "reference", False, False)[0] == "cpu"
    with pytest.raises(InputError, match="--device cpu"):
        backend("cuda", "auto", False, False)
