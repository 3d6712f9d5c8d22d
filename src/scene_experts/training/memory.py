"""Estimate the memory of a training, limit the number of anchors for `--max-memory`, and reuse freed memory."""

from __future__ import annotations

import ctypes
import os
import sys
from dataclasses import dataclass
from pathlib import Path

import torch

from scene_experts.core.errors import InputError
from scene_experts.core.types import Decoded, Render
from scene_experts.native import library as native
from scene_experts.scene import Scene

_SPARE = 9 / 8  # the rasteriser allocates one eighth more than requested
_MMAP_THRESHOLD, _TRIM_THRESHOLD = -3, -1  # parameters of mallopt in glibc
_LARGE, _KEPT = 1 << 30, 256 << 20  # bytes
_TILES = 8  # assumed number of (Gaussian, tile) pairs per Gaussian


@dataclass
class Largest:
    """The largest frame so far: number of rendered Gaussians and number of pixels."""

    gaussians: int = 0
    pixels: int = 0

    def see(self, decoded: Decoded, render: Render) -> None:
        """Update the maxima with one frame."""
        self.gaussians = max(self.gaussians, len(decoded.gaussians))
        self.pixels = max(self.pixels, render.alpha.numel())


def gaussian_bytes(pairs: float = _TILES) -> float:
    """Return the bytes that one rendered Gaussian needs during a step on the CPU. `pairs` is the number of tiles that it overlaps.

    The decoded Gaussian takes 68 bytes (14 floats, its length, its slot). Its gradients, radius and 2D gradient take 76 bytes.
    The rasteriser uses 64 bytes for its record, 16 for its rectangle and key, 64 per thread for sums, and 8 per pair
    (its place in a list, the masks and checkpoints of its batch).
    """
    sums = 64 * min(native.count_threads(), 4)
    return 68 + 76 + _SPARE * (64 + 16 + sums + 8 * pairs)


def frame_bytes(gaussians: int, pixels: int, pairs: float = _TILES) -> int:
    """Return the bytes of all buffers of one frame on the CPU, forward and backward.

    A pixel takes 20 bytes for image, alpha and depth, and 24 for target and gradient. The rasteriser uses 4 bytes per pixel for the
    transmittance and 8 for the data of its tile.
    """
    return int(gaussians * gaussian_bytes(pairs) + pixels * (44 + _SPARE * 12))


def row_bytes(scene: Scene) -> int:
    """Return the bytes of one row of the table during training: values, gradients, both moments, averages and statistics."""
    columns = [*scene.table.columns().values(), *scene.table.averages.values()]
    return sum(v.element_size() * v[:1].numel() * (4 if v.requires_grad else 1) for v in columns) + 4 * (2 + 2 * scene.K)


def anchor_cap(scene: Scene, cap: int, max_memory: float, largest: Largest) -> int:
    """Return the current limit on the number of anchors; 0 means no limit.

    Reserved are one more frame of the largest size, to which each new row adds its share of Gaussians, and a copy of the table, which a
    save and the export of the run may hold. Each edit may fill half of what is left, because some of this is an estimate; the next edit
    measures again.

    Args:
        scene: The scene.
        cap: The limit that the user set; 0 means no limit.
        max_memory: Limit on the memory that `used_bytes` reports, GiB; 0 means no limit.
        largest: The largest frame so far.
    """
    if max_memory <= 0:
        return cap
    n = len(scene.table)
    share = largest.gaussians / max(n, 1)
    row = row_bytes(scene)
    left = max_memory * 2**30 - used_bytes(scene.table.device) - frame_bytes(largest.gaussians, largest.pixels) - n * row
    room = max(0, int(left / 2 / (3 * row + share * gaussian_bytes())))  # 3: an edit holds old and new columns at once, and the copy
    return min(n + room, cap) if cap else max(n + room, 1)


def check_start(scene: Scene, begun: bool, max_memory: float) -> None:
    """Raise InputError if a training cannot begin within `max_memory` GiB (0: no limit): its gradients and moments have no room.

    begun: Whether the moments are already there, as in a resumed training.
    """
    if max_memory <= 0:
        return
    learned = sum(v.element_size() * v.numel() for v in scene.table.params.values())
    needed = (used_bytes(scene.table.device) + learned * (1 if begun else 3)) / 2**30
    if needed > max_memory:
        raise InputError(
            f"expected a start within --max-memory {max_memory:g} GiB, found {len(scene.table):,} {scene.traits.rows} that need about "
            f"{needed:.2f} GiB; raise --max-memory or start from fewer points"
        )


def used_bytes(device: torch.device) -> int:
    """Return the memory of this process, bytes: reserved GPU memory for CUDA, else resident memory. 0 if the system does not report it."""
    if device.type == "cuda":
        return torch.cuda.memory_reserved(device)
    try:
        return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")
    except (OSError, ValueError, IndexError, AttributeError):
        return _most_used()


def _most_used() -> int:
    """Return the peak resident memory of this process, bytes, for systems that report only the peak (macOS). 0 if unknown."""
    try:
        import resource
    except ImportError:
        return 0
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * (1 if sys.platform == "darwin" else 1024)


def reuse_freed() -> bool:
    """Let the C library keep up to 256 MiB of freed memory for reuse instead of returning it to the system.

    Each iteration allocates new gradients. With a million Gaussians, page faults of new memory took a quarter of its time.

    Returns:
        Whether the setting is active. It is not if the C library is not glibc, or if environment variables configure malloc.
    """
    if not sys.platform.startswith("linux") or any(name.startswith("MALLOC_") for name in os.environ) or "GLIBC_TUNABLES" in os.environ:
        return False
    try:
        mallopt = ctypes.CDLL(None).mallopt
    except (OSError, AttributeError):
        return False
    return bool(mallopt(_MMAP_THRESHOLD, _LARGE)) and bool(mallopt(_TRIM_THRESHOLD, _KEPT))
