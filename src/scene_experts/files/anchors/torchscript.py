"""Single decoder networks as TorchScript, the form that Scaffold-GS writes and its readers expect:
one file per network, both ways.

Experts have no such form; they are stored in moe.safetensors. Reading takes the tensors out of the
archives and executes nothing.
"""

from __future__ import annotations

import io
import re
import warnings
from itertools import pairwise
from pathlib import Path

import torch
from torch import Tensor, nn

from scene_experts.core.errors import InputError
from scene_experts.core.io import write_bytes
from scene_experts.core.reading import torch_archive
from scene_experts.files.anchors.data import Network

FILES = {"opacity": "opacity_mlp.pt", "cov": "cov_mlp.pt", "color": "color_mlp.pt"}
EXTRA_FILES = {"feature_bank": "feature_bank_mlp.pt", "appearance": "embedding_appearance.pt"}
UNITED_FILE = "checkpoints.pth"  # all networks in one file, as some versions of Scaffold-GS write them
ACTIVATIONS = {"opacity": "tanh", "cov": "none", "color": "sigmoid"}
_LAYERS = {"tanh": nn.Tanh(), "sigmoid": nn.Sigmoid(), "none": None}


def write(folder: Path, networks: dict[str, Network]) -> None:
    """Write each network as a trace of Sequential(Linear, ReLU, ..., Linear[, activation]), and the
    appearance codes as an embedding.

    networks: by attribute; opacity, cov, color, and where present feature_bank and appearance.
    Raises RunError when the disk is full.
    """
    for attribute, network in networks.items():
        if attribute == "appearance":
            _save_trace(folder / EXTRA_FILES[attribute], _Codes(network["table"]), torch.zeros(1, dtype=torch.long))
            continue
        module = sequential(attribute, network)
        _save_trace(folder / (FILES | EXTRA_FILES)[attribute], module, torch.rand(1, network["w1"].shape[2]))


def sequential(attribute: str, network: Network) -> nn.Sequential:
    """A single network in the form of Scaffold-GS: Linear, ReLU, ..., Linear and the activation of
    the attribute."""
    layers: list[nn.Module] = []
    for weight, bias in _linear_layers(network):
        linear = nn.Linear(weight.shape[1], weight.shape[0])
        linear.load_state_dict({"weight": weight, "bias": bias})
        layers += [nn.ReLU(), linear]
    last = nn.Softmax(dim=1) if attribute == "feature_bank" else _LAYERS[ACTIVATIONS[attribute]]
    return nn.Sequential(*layers[1:], *([last] if last else []))


class _Codes(nn.Module):
    """The embedding of appearance codes, by the name that readers of Scaffold-GS expect."""

    def __init__(self, table: Tensor) -> None:
        super().__init__()
        self.embedding = nn.Embedding.from_pretrained(table.detach().cpu().float())

    def forward(self, view: Tensor) -> Tensor:
        return self.embedding(view)


def _save_trace(path: Path, module: nn.Module, example: Tensor) -> None:
    buffer = io.BytesIO()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)  # torch.jit is deprecated, and the only form that these readers know
        torch.jit.save(torch.jit.trace(module.eval(), (example,)), buffer)
    write_bytes(path, buffer.getvalue())


def _linear_layers(network: Network) -> list[tuple[Tensor, Tensor]]:
    """(weight, bias) of the linear layers of a single network, first to last, float32 on the
    CPU."""
    depth = sum(re.fullmatch(r"middle\.\d+\.weight", name) is not None for name in network)
    pairs = [(network["w1"][0], network["b1"][0])]
    pairs += [(network[f"middle.{i}.weight"], network[f"middle.{i}.bias"]) for i in range(depth)]
    pairs += [(network["w2"][0], network["b2"][0])]
    return [(w.detach().cpu().float(), b.detach().cpu().float()) for w, b in pairs]


def read(folder: Path) -> dict[str, Network]:
    """The networks in a folder, by attribute, with E = 1: from one file per network, or from
    checkpoints.pth with all of them.

    Where present, feature_bank likewise and appearance as {"table": [V, dim]}. Raises InputError
    for networks that are missing or have another form.
    """
    folder = Path(folder)
    names = FILES | EXTRA_FILES
    united = folder / UNITED_FILE
    if not (folder / FILES["opacity"]).is_file() and united.is_file():
        tensors = torch_archive.read_tensors(united)
        states = {key: _below(tensors, name.removesuffix(".pt")) for key, name in names.items()}
        states["appearance"] = _below(tensors, "appearance")
        states = {key: state for key, state in states.items() if state}
    else:
        states = {key: torch_archive.read_tensors(folder / name) for key, name in names.items() if (folder / name).is_file()}
    absent = [name for key, name in FILES.items() if key not in states]
    if absent:
        raise InputError(f"expected {', '.join(FILES.values())} in {folder}, found no {', '.join(absent)}; copy the whole result folder")
    table = states.pop("appearance", {})
    out = {key: _stacked(state, f"{folder}, {names[key]}") for key, state in states.items()}
    if table:
        out["appearance"] = {"table": next(iter(table.values())).float()}
    return out


def _below(tensors: dict[str, Tensor], prefix: str) -> dict[str, Tensor]:
    return {name.removeprefix(f"{prefix}."): value for name, value in tensors.items() if name.startswith(f"{prefix}.")}


def _stacked(state: dict[str, Tensor], where: str) -> Network:
    """The tensors of a Sequential(Linear, ReLU, ..., Linear) by our names. Raises InputError for
    shapes that do not fit together."""
    numbers = sorted({int(match[1]) for name in state if (match := re.fullmatch(r"(\d+)\.(weight|bias)", name))})
    if len(numbers) < 2 or state.keys() != {f"{i}.{kind}" for i in numbers for kind in ("weight", "bias")}:
        raise InputError(f"expected a network of linear layers (0.weight, 0.bias, 2.weight, ...) in {where}, found {sorted(state)[:8]}")
    layers = [(state[f"{i}.weight"].float(), state[f"{i}.bias"].float()) for i in numbers]
    chain = all(w.dim() == 2 and b.shape == w.shape[:1] for w, b in layers)
    if not chain or any(a.shape[0] != b.shape[1] for (a, _), (b, _) in pairwise(layers)):
        raise InputError(
            f"expected linear layers that fit together in {where}, found {[list(w.shape) for w, _ in layers]}; get the file again"
        )
    (w1, b1), *middle, (w2, b2) = layers
    out = {"w1": w1[None], "b1": b1[None], "w2": w2[None], "b2": b2[None]}
    for i, (w, b) in enumerate(middle):
        out |= {f"middle.{i}.weight": w, f"middle.{i}.bias": b}
    return out
