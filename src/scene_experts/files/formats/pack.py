"""Shared by the packed formats: row order, unit quaternions and their smallest three components,
bytes, turned frames, size limits."""

from __future__ import annotations

import logging
import math
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from scene_experts.core.reading.budget import Damaged
from scene_experts.core.reading.source import Source
from scene_experts.files.formats.morton import AXIS_BITS, morton
from scene_experts.files.formats.splats import Splats

log: logging.Logger = logging.getLogger(__name__)
Floats = NDArray[np.float64]
Bytes = NDArray[np.uint8]

MAX_GAUSSIANS = 50_000_000  # of a compressed file; readers refuse more before they allocate memory
_EDGE = 0.25 / 255  # bytes 0 and 255 are read this far inside [0, 1], so that logits are finite
_SIGNS = {  # of x, y, z after half a turn about an axis
    "x": (1, -1, -1),
    "z": (-1, -1, 1),
}
_PARITY = (  # how often x, y, z occur in each harmonic, by coefficient: (odd x, odd y, odd z)
    (0, 0, 0), (0, 1, 0), (0, 0, 1), (1, 0, 0), (1, 1, 0), (0, 1, 1), (0, 0, 0), (1, 0, 1), (0, 0, 0),
    (0, 1, 0), (1, 1, 1), (0, 1, 0), (0, 0, 1), (1, 0, 0), (0, 0, 1), (1, 0, 0),
)  # fmt: skip


def check_count(source: Source, count: int, bytes_each: int) -> None:
    """Raise Damaged where a file declares more Gaussians than are read, or more than its size can
    honestly unpack to.

    bytes_each: what a Gaussian takes in memory while it is decoded.
    """
    if count > MAX_GAUSSIANS:
        raise Damaged(f"{count:,} Gaussians declared, above the limit of {MAX_GAUSSIANS:,}")
    if count * bytes_each > source.budget.allowance(source.size):
        raise Damaged(f"{source.size:,} bytes that unpack to {count:,} Gaussians")
    source.spend_bytes(count * bytes_each)


def decoded_bytes(degree: int) -> int:
    """Bytes that a Gaussian takes while it is decoded in float64: position, scale, rotation,
    opacity and harmonics."""
    return 8 * (11 + 3 * (degree + 1) ** 2)


def morton_order(means: Tensor) -> Tensor:
    """Rows [N] of positions [N, 3] along the Morton curve through their bounding box: near rows
    compress well. Ties keep their order."""
    xyz = means.double().numpy()
    if not len(xyz):
        return torch.zeros(0, dtype=torch.int64)
    low = xyz.min(0)
    span = (xyz.max(0) - low).max()
    cells = ((xyz - low) * (((1 << AXIS_BITS) - 1) / (span if span > 0 else 1.0))).astype(np.int64)
    return torch.from_numpy(np.argsort(morton(cells), kind="stable"))


def unit_quats(splats: Splats) -> Floats:
    """Quaternions [N, 4] (w, x, y, z) of length 1; the identity for those of length 0."""
    q = splats.quats.double().numpy()
    length = np.linalg.norm(q, axis=1, keepdims=True)
    return np.where(length > 0, q / np.where(length > 0, length, 1), [1.0, 0, 0, 0])


def smallest_three(quats: Floats) -> tuple[NDArray[np.intp], Floats]:
    """The index of the largest component [N], and the others [N, 3] in order, for the sign that
    makes the largest positive."""
    largest = np.abs(quats).argmax(1)
    rows = np.arange(len(quats))
    signed = quats * np.where(quats[rows, largest] < 0, -1.0, 1.0)[:, None]
    return largest, signed[np.arange(4) != largest[:, None]].reshape(-1, 3)


def from_smallest_three(largest: NDArray[Any], rest: Floats) -> Floats:
    """Unit quaternions [N, 4], the inverse of `smallest_three`."""
    out = np.empty((len(rest), 4))
    kept = np.arange(4) != np.asarray(largest)[:, None]
    out[kept] = rest.ravel()
    out[~kept] = np.sqrt(np.maximum(0.0, 1 - (rest * rest).sum(1)))
    return out / np.linalg.norm(out, axis=1, keepdims=True)


def alphas(splats: Splats) -> Floats:
    """Opacities [N] in (0, 1)."""
    return splats.opacity_logit.double().sigmoid().numpy()


def to_bytes(values: Floats) -> Bytes:
    """round(255 v), clipped to a byte."""
    return np.clip(np.rint(values * 255), 0, 255).astype(np.uint8)


def byte_logits(values: NDArray[Any]) -> NDArray[np.float32]:
    """Logits [N] of opacities stored as bytes."""
    return logits(np.asarray(values, np.float64) / 255, _EDGE)


def logits(opacity: Floats, edge: float = 1e-7) -> NDArray[np.float32]:
    """Logits [N] of opacities, clipped to [edge, 1 - edge] so that they are finite."""
    a = np.clip(opacity, edge, 1 - edge)
    return np.log(a / (1 - a)).astype(np.float32)


def turn(splats: Splats, axis: Literal["x", "z"]) -> Splats:
    """The Gaussians after half a turn of the frame about an axis. Applied twice it changes nothing.
    Scales keep their axes."""
    return flip(splats, _SIGNS[axis])


def flip(splats: Splats, signs: tuple[int, int, int], reuse: bool = False) -> Splats:
    """The Gaussians in a frame whose axes x, y, z are these signs (1 or -1) times the old ones.
    Applied twice it changes nothing. Scales keep their axes. reuse: write the harmonics, most of
    the memory, over those of `splats`."""
    x, y, z = signs
    parities = np.prod(np.where(np.array(_PARITY[: splats.sh.shape[1]]) == 1, np.array(signs), 1), axis=1)
    factors = torch.from_numpy(parities).float()[:, None]
    return Splats(
        splats.means * torch.tensor(signs, dtype=torch.float32),
        splats.log_scales,
        splats.quats * torch.tensor([1, y * z, x * z, x * y], dtype=torch.float32),
        splats.opacity_logit,
        splats.sh.mul_(factors) if reuse else splats.sh * factors,
    )


def warn_of_transforms(path: Path) -> None:
    """Log that a file places its Gaussians by transforms, which its reader does not apply."""
    log.warning("%s moves, turns or scales its Gaussians by transforms of nodes, which are not applied: apply them before the import", path)


def scaled(splats: Splats, factor: float) -> Splats:
    """The Gaussians with all lengths times `factor`, above 0."""
    if factor == 1:
        return splats
    means, log_scales = splats.means.double() * factor, splats.log_scales.double() + math.log(factor)
    return Splats(means.float(), log_scales.float(), splats.quats, splats.opacity_logit, splats.sh)


def tensor(values: NDArray[Any]) -> torch.Tensor:
    """A float32 tensor with memory of its own. Numbers beyond float32 become infinite, which
    readers refuse."""
    with np.errstate(over="ignore"):
        return torch.from_numpy(np.array(values, dtype=np.float32, order="C"))
