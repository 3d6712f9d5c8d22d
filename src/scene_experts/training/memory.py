"""How much memory a training holds and will hold: the cap on anchors that `--max-memory` sets; and that freed memory is used again."""

from __future__ import annotations

import ctypes
import os
import sys
from dataclasses import dataclass
from pathlib import Path

import torch

from scene_experts.core.types import Decoded, Render
from scene_experts.native import library as native
from scene_experts.scene import Scene

_SPARE = 9 / 8  # the rasteriser's buffers grow an eighth beyond what is asked for
_MMAP_THRESHOLD, _TRIM_THRESHOLD = -3, -1  # of mallopt in glibc
_LARGE, _KEPT = 1 << 30, 256 << 20  # bytes
_TILES = 8  # (Gaussian, tile) pairs a Gaussian, where nobody has counted


@dataclass
class Largest:
    """The largest frame so far: Gaussians drawn and pixels."""

    gaussians: int = 0
    pixels: int = 0

    def see(self, decoded: Decoded, render: Render) -> None:
        """Count one frame in."""
        self.gaussians = max(self.gaussians, len(decoded.gaussians))
        self.pixels = max(self.pixels, render.alpha.numel())


def gaussian_bytes(pairs: float = _TILES) -> float:
    """Bytes that one drawn Gaussian takes during a step on the CPU; `pairs`: picture tiles that it touches.

    68 as decoded (14 floats, its length, its slot), 76 of gradients, radius and 2D gradient; in the rasteriser 64 of its record, 16 of its
    rectangle and key, 64 of sums per thread, and 8 a pair (its place in a list, the masks and checkpoints of its batch).
    """
    sums = 64 * min(native.count_threads(), 4)
    return 68 + 76 + _SPARE * (64 + 16 + sums + 8 * pairs)


def frame_bytes(gaussians: int, pixels: int, pairs: float = _TILES) -> int:
    """Bytes of all the buffers of one frame, forward and backward, on the CPU.

    A pixel takes 20 of picture, alpha and depth, 24 of target and gradient, and in the rasteriser 4 of transmittance and 8 of its tile's.
    """
    return int(gaussians * gaussian_bytes(pairs) + pixels * (44 + _SPARE * 12))


def row_bytes(scene: Scene) -> int:
    """Bytes of one row of the table in training: values, gradients, both moments, statistics."""
    columns = scene.table.columns().values()
    return sum(v.element_size() * v[:1].numel() * (4 if v.requires_grad else 1) for v in columns) + 4 * (2 + 2 * scene.K)


def anchor_cap(scene: Scene, cap: int, max_memory: float, largest: Largest) -> int:
    """The cap on anchors now: the user's own, and what still fits below `max_memory` GiB (0: no cap); see `used_bytes`.

    Room is kept for another of the largest frames, and each new row brings its share of Gaussians into it.
    """
    if max_memory <= 0:
        return cap
    n = len(scene.table)
    share = largest.gaussians / max(n, 1)
    left = max_memory * 2**30 - used_bytes(scene.table.device) - frame_bytes(largest.gaussians, largest.pixels)
    room = max(0, int(left / (2 * row_bytes(scene) + share * gaussian_bytes())))  # twice: a row edit holds old and new columns at once
    return min(n + room, cap) if cap else max(n + room, 1)


def used_bytes(device: torch.device) -> int:
    """Memory that this process holds, bytes: of the GPU for a CUDA device, else resident; 0 where the system does not tell."""
    if device.type == "cuda":
        return torch.cuda.memory_reserved(device)
    try:
        return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")
    except (OSError, ValueError, IndexError, AttributeError):
        return _most_used()


def _most_used() -> int:
    """The most that this process ever held resident, where the system tells that alone (macOS)."""
    try:
        import resource
    except ImportError:
        return 0
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * (1 if sys.platform == "darwin" else 1024)


def reuse_freed() -> bool:
    """Let the C library use freed arrays again, up to 256 MiB of them, instead of giving each one back and asking for new pages.

    Gradients of a million Gaussians are made anew in every iteration: to touch new pages was a quarter of its time. Returns whether
    it took: not where the C library is another than glibc, or where the user has set it up through the environment.
    """
    if not sys.platform.startswith("linux") or any(name.startswith("MALLOC_") for name in os.environ) or "GLIBC_TUNABLES" in os.environ:
        return False
    try:
        mallopt = ctypes.CDLL(None).mallopt
    except (OSError, AttributeError):
        return False
    return bool(mallopt(_MMAP_THRESHOLD, _LARGE)) and bool(mallopt(_TRIM_THRESHOLD, _KEPT))
