"""A scene in one small file: exact lattice positions, features and lengths in 16 bits, the networks as they are.

A Scaffold-GS anchor takes 316 bytes, of which 32 say nothing (normals, opacity, rotation) and 12 are a position on a known lattice. Here
the position is an integer cell (`lattice_code`, 1 - 4 bytes, exact), features and offsets are half precision, and log-scalings are 16-bit
fixed point per channel: halves are coarse just where scalings lie (steps of 0.004 between 4 and 8, 0.2 % of a length). Bytes are grouped by
significance and deflated. The file is a safetensors file with a checksum; rows come back in another order, which no renderer minds.
"""

from __future__ import annotations

import zlib
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from scene_experts.core.checkpoint import read_tensors, write_tensors
from scene_experts.core.errors import InputError
from scene_experts.files.anchors.frame import Network, cell_positions
from scene_experts.files.anchors.lattice_code import AXIS_BITS, decode_steps, encode_steps, morton, unmorton
from scene_experts.files.anchors.networks import check_networks, flat_names, from_flat_names

KIND, FORMAT = "compact scene", 1
Code = Literal["float32", "float16", "uint16", "uint8"]


@dataclass(frozen=True)
class Coding:
    """How the columns are stored. uint16 and uint8 are fixed point between each channel's least and greatest value."""

    feature: Code = "float16"
    offsets: Code = "float16"
    log_scaling: Code = "uint16"


@dataclass(frozen=True)
class Compact:
    """A compact scene, in the frame of its file: position = cell * voxel + origin."""

    cells: Tensor  # [N, 3] int64
    voxel: float
    origin: tuple[float, float, float]
    feature: Tensor  # [N, F] float32
    log_scaling: Tensor  # [N, 6] float32
    offsets: Tensor  # [N, K, 3] float32
    networks: dict[str, Network]
    sidecar: dict[str, Any]

    @property
    def xyz(self) -> Tensor:
        """Positions [N, 3] float32."""
        return cell_positions(self.cells, self.voxel, self.origin)


@dataclass(frozen=True)
class Sizes:
    """Bytes of a compact file."""

    total: int
    anchors: int
    networks: int
    per_anchor: float


def write_compact(
    path: Path,
    cells: Tensor,
    voxel: float,
    origin: tuple[float, float, float],
    feature: Tensor,
    log_scaling: Tensor,
    offsets: Tensor,
    networks: dict[str, Network],
    sidecar: dict[str, Any],
    coding: Coding = Coding(),
) -> Sizes:
    """Write a scene, already in the input frame (`frame.lattice_to_input`), to one file, atomically.

    cells [N, 3] int64, feature [N, F], log_scaling [N, 6], offsets [N, K, 3], networks as in `networks`.
    Raises InputError for values that are not finite or cells spread over more than 2^21 voxels; RunError when the disk is full.
    """
    place = cells.detach().cpu().numpy().astype(np.int64)
    low = place.min(0) if len(place) else np.zeros(3, np.int64)
    spread = int((place.max(0) - low).max()) if len(place) else 0
    if spread >= 1 << AXIS_BITS:
        raise InputError(f"expected a scene at most {1 << AXIS_BITS:,} voxels wide, found {spread + 1:,}; remove far anchors")
    keys = morton(place - low)
    order = np.argsort(keys, kind="stable")
    blobs = {"cells": deflate(encode_steps(keys[order]))}
    codes, n = {}, len(place)
    for name, value in (("feature", feature), ("offsets", offsets), ("log_scaling", log_scaling)):
        array = value.detach().cpu().float().numpy().reshape(n, int(np.prod(value.shape[1:])))[order]
        if not np.isfinite(array).all():
            raise InputError(f"expected finite {name}, found others in {(~np.isfinite(array)).any(1).sum():,} anchors; train again")
        codes[name], parts = _encode(array, getattr(coding, name))
        blobs |= {name if part == "values" else f"{name}.{part}": blob for part, blob in parts.items()}
    meta = {
        "N": n,
        "K": offsets.shape[1],
        "F": feature.shape[1],
        "voxel": voxel,
        "origin": list(origin),
        "low": low.tolist(),
        "codes": codes,
        "scene": sidecar,
    }
    tensors = {name: torch.from_numpy(np.ascontiguousarray(blob)) for name, blob in blobs.items()}
    flat = {f"network.{name}": value.detach().cpu() for name, value in flat_names(networks).items()}
    write_tensors(Path(path), tensors | flat, KIND, FORMAT, meta)
    anchors = sum(t.numel() * t.element_size() for t in tensors.values())
    return Sizes(Path(path).stat().st_size, anchors, sum(t.numel() * t.element_size() for t in flat.values()), anchors / max(n, 1))


def read_compact(path: Path) -> Compact:
    """A compact scene. Raises InputError when the file is absent, another, damaged, or of another format version."""
    tensors, meta = read_tensors(path, KIND, FORMAT)
    try:
        n, K, F = int(meta["N"]), int(meta["K"]), int(meta["F"])
        keys = decode_steps(inflate(tensors["cells"].numpy(), 9 * n, exact=False))
        cells = unmorton(keys) + np.array(meta["low"], np.int64)
        columns = {
            name: _decode(tensors, name, meta["codes"][name], n, width)
            for name, width in (("feature", F), ("offsets", 3 * K), ("log_scaling", 6))
        }
        x, y, z = (float(v) for v in meta["origin"])
        voxel, scene = float(meta["voxel"]), dict(meta["scene"])
        if cells.shape != (n, 3) or not voxel > 0:
            raise ValueError(f"{len(cells)} cells of edge {voxel}")
    except (KeyError, ValueError, TypeError, OverflowError, zlib.error) as error:
        raise InputError(
            f"expected a whole compact scene at {path}, found one that does not fit together ({error}); export it again"
        ) from None
    networks = from_flat_names({k.removeprefix("network."): v for k, v in tensors.items() if k.startswith("network.")})
    check_networks(networks, str(path))
    offsets = columns["offsets"].reshape(n, K, 3)
    return Compact(torch.from_numpy(cells), voxel, (x, y, z), columns["feature"], columns["log_scaling"], offsets, networks, scene)


def _encode(array: NDArray[np.float32], code: Code) -> tuple[Code, dict[str, NDArray[Any]]]:
    """What is stored for one array [N, C]: the code used, and the parts by name (fixed point has a low and a step per channel)."""
    if code == "float16" and array.size and np.abs(array).max() > float(np.finfo(np.float16).max):
        code = "float32"  # beyond the reach of halves
    if code in ("float32", "float16"):
        return code, {"values": deflate(array.astype(code))}
    steps = float(np.iinfo(code).max)
    low = array.min(0).astype(np.float64) if len(array) else np.zeros(array.shape[1])
    step = (array.max(0) - low) / steps if len(array) else np.zeros(array.shape[1])
    level = np.rint((array - low) / np.where(step > 0, step, 1.0)).clip(0, steps)
    return code, {"values": deflate(level.astype(code)), "low": low, "step": step}


def _decode(tensors: dict[str, Tensor], name: str, code: str, n: int, width: int) -> Tensor:
    """The inverse of `_encode`, [N, C] float32."""
    if code not in ("float32", "float16", "uint16", "uint8"):
        raise ValueError(f"code {code!r}")
    item = np.dtype(code)
    planes = inflate(tensors[name].numpy(), n * width * item.itemsize).reshape(width, item.itemsize, n)
    values = np.ascontiguousarray(planes.transpose(2, 0, 1)).reshape(n, width * item.itemsize).view(item.newbyteorder("<"))
    if item.kind == "u":
        low, step = tensors[f"{name}.low"].numpy(), tensors[f"{name}.step"].numpy()
        values = values * step + low
    return torch.from_numpy(np.ascontiguousarray(values.astype(np.float32)))


def deflate(array: NDArray[Any]) -> NDArray[np.uint8]:
    """Bytes of an array [N] or [N, C], channel after channel and byte after byte of equal significance, compressed (zlib)."""
    flat = array.reshape(len(array), -1) if len(array) else np.zeros((0, 1), array.dtype)
    raw = np.ascontiguousarray(flat).astype(array.dtype.newbyteorder("<"), copy=False).view(np.uint8).reshape(*flat.shape, array.itemsize)
    return np.frombuffer(zlib.compress(np.ascontiguousarray(raw.transpose(1, 2, 0)).tobytes(), 6), np.uint8).copy()


def inflate(blob: NDArray[np.uint8], size: int, exact: bool = True) -> NDArray[np.uint8]:
    """The `size` bytes (or at most as many) that `deflate` was given, still in its order. Raises ValueError for another number."""
    machine = zlib.decompressobj()
    data = machine.decompress(blob.tobytes(), size + 1)  # never more than what fits, whatever the file claims
    if len(data) > size or not (machine.eof and (len(data) == size or not exact)):
        raise ValueError(f"{len(data)} bytes where {size} belong")
    return np.frombuffer(data, np.uint8)
