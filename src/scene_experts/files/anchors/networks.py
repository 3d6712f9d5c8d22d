"""The decoder networks of a scene as files: TorchScript for single networks (Scaffold-GS), one safetensors file for experts.

In memory a network is stacked tensors: w1 [E, H, D], b1 [E, H], w2 [E, out, H], b2 [E, out], with router_w [E, F] and router_b [E] where
there is a router, and middle.<i>.weight [H, H] / middle.<i>.bias [H] where a single network (E = 1) is deeper than two layers.
"""

from __future__ import annotations

import io
import re
import warnings
from itertools import pairwise
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from scene_experts.core.checkpoint import read_tensors, write_tensors
from scene_experts.core.errors import InputError
from scene_experts.core.io import write_bytes
from scene_experts.files.anchors.frame import Network
from scene_experts.files.archive import torch_archive
from scene_experts.scene.anchors.mlp import ATTRIBUTES

FILES = {"opacity": "opacity_mlp.pt", "cov": "cov_mlp.pt", "color": "color_mlp.pt"}
EXTRA_FILES = {"feature_bank": "feature_bank_mlp.pt", "appearance": "embedding_appearance.pt"}
ACTIVATIONS = {"opacity": "tanh", "cov": "none", "color": "sigmoid"}
MOE_FILE, MOE_KIND, MOE_FORMAT = "moe.safetensors", "mixture of experts", 1
_LAYERS = {"tanh": nn.Tanh(), "sigmoid": nn.Sigmoid(), "none": None}
_RENAMED = {"router_w": "router.weight", "router_b": "router.bias", **{n: f"experts.{n}" for n in ("w1", "b1", "w2", "b2")}}


def is_plain(networks: dict[str, Network]) -> bool:
    """Whether every attribute has a single network, as Scaffold-GS does."""
    return all(len(networks[a]["w1"]) == 1 and "router_w" not in networks[a] for a in ATTRIBUTES)


# --- TorchScript --------------------------------------------------------------------------------------------------------------------------


def write_torchscript(folder: Path, networks: dict[str, Network]) -> None:
    """Write opacity_mlp.pt, cov_mlp.pt and color_mlp.pt as traces of Sequential(Linear, ReLU, ..., Linear[, activation]); where present,
    feature_bank_mlp.pt likewise and embedding_appearance.pt, a trace of a module with an embedding."""
    for attribute, network in networks.items():
        if attribute == "appearance":
            _save_trace(folder / EXTRA_FILES[attribute], _Codes(network["table"]), torch.zeros(1, dtype=torch.long))
            continue
        module = sequential(attribute, network)
        _save_trace(folder / (FILES | EXTRA_FILES)[attribute], module, torch.rand(1, network["w1"].shape[2]))


def sequential(attribute: str, network: Network) -> nn.Sequential:
    """A single network as Scaffold-GS's readers know it: Linear, ReLU, ..., Linear and the attribute's activation."""
    layers: list[nn.Module] = []
    for weight, bias in _linear_layers(network):
        linear = nn.Linear(weight.shape[1], weight.shape[0])
        linear.load_state_dict({"weight": weight, "bias": bias})
        layers += [nn.ReLU(), linear]
    last = nn.Softmax(dim=1) if attribute == "feature_bank" else _LAYERS[ACTIVATIONS[attribute]]
    return nn.Sequential(*layers[1:], *([last] if last else []))


class _Codes(nn.Module):
    """The embedding of appearance codes under the name that Scaffold-GS's readers expect."""

    def __init__(self, table: Tensor) -> None:
        super().__init__()
        self.embedding = nn.Embedding.from_pretrained(table.detach().cpu().float())

    def forward(self, view: Tensor) -> Tensor:
        return self.embedding(view)


def _save_trace(path: Path, module: nn.Module, example: Tensor) -> None:
    buffer = io.BytesIO()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)  # torch.jit is deprecated, and the only format their readers know
        torch.jit.save(torch.jit.trace(module.eval(), (example,)), buffer)
    write_bytes(path, buffer.getvalue())


def _linear_layers(network: Network) -> list[tuple[Tensor, Tensor]]:
    """(weight, bias) of a single network's linear layers, first to last, float32 on the CPU."""
    depth = sum(re.fullmatch(r"middle\.\d+\.weight", name) is not None for name in network)
    pairs = [(network["w1"][0], network["b1"][0])]
    pairs += [(network[f"middle.{i}.weight"], network[f"middle.{i}.bias"]) for i in range(depth)]
    pairs += [(network["w2"][0], network["b2"][0])]
    return [(w.detach().cpu().float(), b.detach().cpu().float()) for w, b in pairs]


def read_torchscript(folder: Path) -> dict[str, Network]:
    """The networks of a Scaffold-GS iteration folder, stacked with E = 1; where present, feature_bank and appearance {"table": [V, dim]}.

    Either one TorchScript file per network, or checkpoints.pth with all of them. Nothing in the files is executed.
    Raises InputError: no networks, an absent one, or one of another form.
    """
    folder = Path(folder)
    names = FILES | EXTRA_FILES
    united = folder / "checkpoints.pth"
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
    """The tensors of a Sequential(Linear, ReLU, ..., Linear) by our names, shapes checked."""
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


# --- one safetensors file -----------------------------------------------------------------------------------------------------------------


def flat_names(networks: dict[str, Network]) -> dict[str, Tensor]:
    """The tensors by their names in files: <attribute>.router.{weight,bias}, <attribute>.experts.{w1,b1,w2,b2}."""
    return {f"{a}.{_RENAMED.get(name, name)}": value.detach() for a, network in networks.items() for name, value in network.items()}


def from_flat_names(tensors: dict[str, Tensor]) -> dict[str, Network]:
    """The inverse of `flat_names`."""
    back = {long: short for short, long in _RENAMED.items()}
    out: dict[str, Network] = {}
    for name, value in tensors.items():
        attribute, _, rest = name.partition(".")
        out.setdefault(attribute, {})[back.get(rest, rest)] = value
    return out


def write_moe(path: Path, networks: dict[str, Network], sidecar: dict[str, Any]) -> None:
    """Write routers and experts with the scene's description. Raises RunError when the disk is full."""
    write_tensors(path, flat_names(networks), MOE_KIND, MOE_FORMAT, sidecar)


def read_moe(path: Path) -> tuple[dict[str, Network], dict[str, Any]]:
    """Routers and experts, and the description they were written with. Raises InputError when the file is damaged or another."""
    tensors, sidecar = read_tensors(path, MOE_KIND, MOE_FORMAT)
    networks = from_flat_names(tensors)
    check_networks(networks, str(path))
    return networks, sidecar


def check_networks(networks: dict[str, Network], where: str) -> None:
    """Raises InputError unless all three attributes are there with stacked tensors that fit together."""
    for attribute in ATTRIBUTES:
        n = networks.get(attribute, {})
        if not {"w1", "b1", "w2", "b2"} <= n.keys():
            raise InputError(f"expected the networks of {', '.join(ATTRIBUTES)} in {where}, found {sorted(networks)}; write the file again")
        if any(n[name].ndim != rank for name, rank in (("w1", 3), ("b1", 2), ("w2", 3), ("b2", 2))):
            raise InputError(f"expected stacked {attribute} networks in {where}, found tensors of other shapes; write the file again")
        (E, H, _), out = n["w1"].shape, n["w2"].shape[1]
        shapes = {"b1": (E, H), "w2": (E, out, H), "b2": (E, out), "router_b": (E,)}
        wrong = [name for name, shape in shapes.items() if name in n and n[name].shape != shape]
        if wrong or (E > 1 and ("router_w" not in n or len(n["router_w"]) != E)):
            raise InputError(
                f"expected {attribute} networks of {E} experts that fit together in {where}, found others; write the file again"
            )
