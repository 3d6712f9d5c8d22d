"""One small file of this package, networks included: exact positions, 16-bit features and lengths.

The networks are stored as they are. An anchor takes 316 bytes in Scaffold-GS's PLY; 32 of them are
constants (normals, opacity, rotation) and 12 a position on a known lattice. Here a position is an
integer cell (1 to 4 bytes, exact), features and offsets are half precision, and log-scalings are
16-bit fixed point per channel, because halves are coarse where scalings lie (steps of 0.004 between
4 and 8, 0.2 % of a length). Offsets of masked Gaussians are left out; one bit per Gaussian marks
them. Bytes are grouped by significance and deflated. The file is a safetensors file with a
checksum. Rows come back in another order, which does not change pictures.

Cells are sorted along the Morton curve, which interleaves the bits of the axes so that near cells
have near keys, and stored as steps along it, each in as many 7-bit groups as it needs.
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
from scene_experts.core.reading import budget
from scene_experts.core.reading.budget import Damaged
from scene_experts.core.reading.numbers import FARTHEST, number, shown, whole_number
from scene_experts.core.reading.source import Source, opening
from scene_experts.files.anchors.data import AnchorData
from scene_experts.files.formats.morton import AXIS_BITS, Keys, morton, unmorton
from scene_experts.files.registry import Format

KIND, VERSION = "compact scene", 1
MOST_ANCHORS, MOST_CHANNELS = 1 << 28, 1 << 12  # of a file; K and F
FARTHEST_CELL = 1 << 52  # coordinate of a cell
Code = Literal["float32", "float16", "uint16", "uint8"]
_GROUP = 7
_MAX_GROUPS = 9  # 63 bits


@dataclass(frozen=True)
class Coding:
    """How the columns are stored. uint16 and uint8 are fixed point between the minimum and maximum
    of each channel."""

    feature: Code = "float16"
    offsets: Code = "float16"
    log_scaling: Code = "uint16"


@dataclass(frozen=True)
class Sizes:
    """Bytes of a compact file."""

    total: int
    anchors: int
    networks: int
    per_anchor: float

    def __str__(self) -> str:
        return f"{self.per_anchor:.1f} bytes per anchor without the networks"


def write(path: Path, data: AnchorData, note: dict[str, Any], coding: Coding = Coding()) -> Sizes:
    """Write a scene to one file, atomically. The note has no place in it: the description says
    more.

    Raises InputError for anchors on no lattice or on several, for values that are not finite, and
    for cells that span more than 2^21 voxels; RunError when the disk is full.
    """
    if "level" in data.columns:
        raise InputError("expected anchors on one lattice for a compact file, found levels of detail; use --format anchors")
    if data.cells is None:
        raise InputError("expected anchors on a lattice of known voxel size for a compact file, found others; use --format anchors")
    place = data.cells.detach().cpu().numpy().astype(np.int64)
    low = place.min(0) if len(place) else np.zeros(3, np.int64)
    spread = int((place.max(0) - low).max()) if len(place) else 0
    if spread >= 1 << AXIS_BITS:
        raise InputError(f"expected a scene at most {1 << AXIS_BITS:,} voxels wide, found {spread + 1:,}; remove far anchors")
    keys = morton(place - low)
    order = np.argsort(keys, kind="stable")
    blobs = {"cells": deflate(encode_steps(keys[order]))}
    codes, n, slots = {}, len(place), data.columns.get("slots")
    drawn = None if slots is None else slots.cpu().numpy()[order]
    if drawn is not None:
        blobs["slots"] = deflate(np.packbits(drawn, axis=1))
    for name in (name for name in ("feature", "offsets", "log_scaling", "interval") if name in data.columns):
        value = data.columns[name]
        array = value.detach().cpu().float().numpy().reshape(n, int(np.prod(value.shape[1:])))[order]
        if drawn is not None and name == "offsets":  # those of masked slots are left out
            array = array.reshape(*drawn.shape, 3)[drawn]
        if not np.isfinite(array).all():
            raise InputError(f"expected finite {name}, found others in {(~np.isfinite(array)).any(1).sum():,} anchors; train again")
        codes[name], parts = _encode(array, getattr(coding, name, "float32"))
        blobs |= {name if part == "values" else f"{name}.{part}": blob for part, blob in parts.items()}
    meta = {
        "N": n,
        "K": data.columns["offsets"].shape[1],
        "F": data.columns["feature"].shape[1],
        "voxel": data.voxel,
        "origin": list(data.origin),
        "low": low.tolist(),
        "codes": codes,
        "scene": data.about,
    }
    tensors = {name: torch.from_numpy(np.ascontiguousarray(blob)) for name, blob in blobs.items()}
    flat = {f"network.{name}": value.detach().cpu() for name, value in data.networks.items()}
    write_tensors(Path(path), tensors | flat, KIND, VERSION, meta)
    anchors = sum(t.numel() * t.element_size() for t in tensors.values())
    return Sizes(Path(path).stat().st_size, anchors, sum(t.numel() * t.element_size() for t in flat.values()), anchors / max(n, 1))


def read(path: Path) -> AnchorData:
    """The scene in a file. Raises InputError for a missing, damaged or other file and for another
    format version."""
    tensors, meta = read_tensors(path, KIND, VERSION)
    with opening(path, budget.COMPACT) as source:
        return _unpack(source, tensors, meta)


def _unpack(source: Source, tensors: dict[str, Tensor], meta: dict[str, Any]) -> AnchorData:
    n = whole_number(meta["N"], "the number of anchors", 0, MOST_ANCHORS)
    K, F = whole_number(meta["K"], "K", 1, MOST_CHANNELS), whole_number(meta["F"], "F", 1, MOST_CHANNELS)
    source.spend_bytes(n * 8 * (3 * K + F + 6 + 12))
    low = np.array([whole_number(v, "a corner of the cells", -FARTHEST_CELL, FARTHEST_CELL) for v in meta["low"]], np.int64)
    origin = tuple(number(v, "the origin of the cells", -FARTHEST, FARTHEST) for v in meta["origin"])
    voxel = number(meta["voxel"], "the edge of a cell", 1e-30, FARTHEST)
    about = dict(meta["scene"])
    keys = decode_steps(inflate(_blob(tensors, "cells"), 9 * n, exact=False))
    if len(keys) != n or low.shape != (3,) or len(origin) != 3:
        raise Damaged(f"{len(keys):,} cells of {n:,} anchors")
    slots = _decode_slots(_blob(tensors, "slots"), n, K) if "slots" in tensors else None
    sizes = {"feature": (n, F), "offsets": (n, 3 * K) if slots is None else (int(slots.sum()), 3), "log_scaling": (n, 6)}
    sizes |= {"interval": (n, 1)} if "interval" in tensors else {}
    columns = {name: _decode(tensors, name, meta["codes"][name], *size) for name, size in sizes.items()}
    step = whole_number(about["step"], "the iteration")
    add_dist = tuple(a for a, used in about["add_dist"].items() if used)
    cells = torch.from_numpy(unmorton(keys) + low)
    columns |= {"interval": columns["interval"][:, 0]} if "interval" in columns else {}
    if slots is not None:
        columns["slots"] = slots
        columns["offsets"] = torch.zeros(n, K, 3).index_put_((slots,), columns["offsets"])
    columns["offsets"] = columns["offsets"].reshape(n, K, 3)
    columns = {"xyz": (cells.double() * voxel + torch.tensor(origin, dtype=torch.float64)).float()} | columns
    networks = {name.removeprefix("network."): value for name, value in tensors.items() if name.startswith("network.")}
    return AnchorData(columns, networks, about, cells, voxel, origin, add_dist, step).checked()


def looks_like(path: Path, head: bytes) -> bool:
    """Whether a file is meant as a compact one: by its name, or by the start of a safetensors file
    (length of a JSON header, header)."""
    return path.suffix == FORMAT.suffix or (head[8:9] == b"{" and 2 <= int.from_bytes(head[:8], "little") < path.stat().st_size)


FORMAT = Format(
    suffix=".compact",
    family="anchors",
    write=write,
    read=read,
    looks_like=looks_like,
)


# --- columns ------------------------------------------------------------------------------------------------------------------------------


def _encode(array: NDArray[np.float32], code: Code) -> tuple[Code, dict[str, NDArray[Any]]]:
    """The code and the stored parts, by name, of one array [N, C]. Fixed point stores a minimum
    (low) and a step per channel."""
    if code == "float16" and array.size and np.abs(array).max() > float(np.finfo(np.float16).max):
        code = "float32"  # too large for half precision
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
        raise Damaged(f"the code {shown(code)}")
    item = np.dtype(code)
    planes = inflate(_blob(tensors, name), n * width * item.itemsize).reshape(width, item.itemsize, n)
    values = np.ascontiguousarray(planes.transpose(2, 0, 1)).reshape(n, width * item.itemsize).view(item.newbyteorder("<"))
    if item.kind == "u":
        low, step = (tensors[f"{name}.{part}"].double().numpy() for part in ("low", "step"))
        if low.shape != (width,) or step.shape != (width,):
            raise Damaged(f"{len(low)} ranges of the {width} channels of {name}")
        values = values * step + low
    return torch.from_numpy(np.ascontiguousarray(values.astype(np.float32)))


def _decode_slots(blob: NDArray[np.uint8], n: int, K: int) -> Tensor:
    """The masks [N, K] bool of slots."""
    planes = inflate(blob, n * -(-K // 8)).reshape(-(-K // 8), n)
    return torch.from_numpy(np.ascontiguousarray(np.unpackbits(planes.T, axis=1, count=K).astype(bool)))


def _blob(tensors: dict[str, Tensor], name: str) -> NDArray[np.uint8]:
    """The compressed bytes of a column."""
    if name not in tensors or tensors[name].dtype != torch.uint8 or tensors[name].dim() != 1:
        raise Damaged(f"no column {name}")
    return tensors[name].numpy()


def deflate(array: NDArray[Any]) -> NDArray[np.uint8]:
    """The compressed (zlib) bytes of an array [N] or [N, C], by channel, then by significance."""
    flat = array.reshape(len(array), -1) if len(array) else np.zeros((0, 1), array.dtype)
    raw = np.ascontiguousarray(flat).astype(array.dtype.newbyteorder("<"), copy=False).view(np.uint8).reshape(*flat.shape, array.itemsize)
    return np.frombuffer(zlib.compress(np.ascontiguousarray(raw.transpose(1, 2, 0)).tobytes(), 6), np.uint8).copy()


def inflate(blob: NDArray[np.uint8], size: int, exact: bool = True) -> NDArray[np.uint8]:
    """The bytes that `deflate` compressed, in its order: `size` of them, or at most `size` unless
    `exact`. Raises ValueError for others."""
    machine = zlib.decompressobj()
    data = machine.decompress(blob.data, size + 1)  # never allocates more than expected, whatever the file declares
    if len(data) > size or not (machine.eof and (len(data) == size or not exact)):
        raise ValueError(f"{len(data)} bytes where {size} are expected")
    return np.frombuffer(data, np.uint8)


# --- cells --------------------------------------------------------------------------------------------------------------------------------


def encode_steps(keys: Keys) -> NDArray[np.uint8]:
    """The bytes of sorted keys [N]: the step to each key in groups of 7 bits, low groups first; the
    top bit says that more follow."""
    steps = np.diff(keys, prepend=np.uint64(0))
    groups = np.stack([(steps >> np.uint64(_GROUP * i)).astype(np.uint8) & 0x7F for i in range(_MAX_GROUPS)], axis=1)
    more = np.stack([steps >> np.uint64(_GROUP * (i + 1)) != 0 for i in range(_MAX_GROUPS)], axis=1)
    used = np.concatenate([np.ones((len(steps), 1), bool), more[:, :-1]], axis=1)
    return np.where(more, groups | 0x80, groups).astype(np.uint8)[used]


def decode_steps(data: NDArray[np.uint8]) -> Keys:
    """The keys that `encode_steps` encoded. Raises ValueError for damaged bytes."""
    if not len(data):
        return np.zeros(0, np.uint64)
    ends = np.flatnonzero(data < 0x80)
    if not len(ends) or ends[-1] != len(data) - 1:
        raise ValueError("a step is cut short")
    starts = np.concatenate([[0], ends[:-1] + 1])
    place = np.arange(len(data)) - np.repeat(starts, ends - starts + 1)
    if place.max() >= _MAX_GROUPS:
        raise ValueError("a step is too long")
    parts = (data & 0x7F).astype(np.uint64) << (_GROUP * place).astype(np.uint64)
    return np.cumsum(np.add.reduceat(parts, starts), dtype=np.uint64)
