"""Measure the memory of a training, limit the number of anchors for `--max-memory`, and reuse freed
memory."""

from __future__ import annotations

import ctypes
import os
import sys
from contextlib import suppress
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
_SEARCHED = 360  # bytes for each Gaussian of the table while densification searches for new rows
_FILLED = 0.92  # share of the limit that growth may fill


@dataclass
class Largest:
    """What a training has needed so far: its largest frame, and what its measured peak of memory
    includes."""

    gaussians: int = 0  # rendered by one frame
    pixels: int = 0
    rows: int = 0  # of the table, visible in one frame
    level: int = 0  # bytes of the process without the table, when the training began
    searched: int = 0  # rows at the last search for new rows
    searching: int = 0  # peak of the process after that search, bytes

    def see(self, decoded: Decoded, render: Render) -> None:
        """Update the maxima with one frame."""
        self.gaussians = max(self.gaussians, len(decoded.gaussians))
        self.pixels = max(self.pixels, render.alpha.numel())
        self.rows = max(self.rows, len(decoded.rows))

    def search(self, rows: int, peak: int) -> None:
        """Record a search for new rows in a table of `rows` rows, and the peak of the process after
        it, bytes."""
        self.searched, self.searching = rows, peak


def gaussian_bytes(pairs: float = _TILES) -> float:
    """Return the bytes that one rendered Gaussian needs during a step on the CPU. `pairs` is the
    number of tiles that it overlaps.

    The decoded Gaussian takes 68 bytes (14 floats, its length, its slot). Its gradients, radius and
    2D gradient take 76 bytes. The rasteriser uses 64 bytes for its record, 16 for its rectangle and
    key, 64 per thread for sums, and 8 per pair (its place in a list, the masks and checkpoints of
    its batch).
    """
    sums = 64 * min(native.count_threads(), 4)
    return 68 + 76 + _SPARE * (64 + 16 + sums + 8 * pairs)


def frame_bytes(gaussians: int, pixels: int, pairs: float = _TILES) -> int:
    """Return the bytes of all buffers of one frame on the CPU, forward and backward.

    A pixel takes 20 bytes for image, alpha and depth, and 24 for target and gradient. The
    rasteriser uses 4 bytes per pixel for the transmittance and 8 for the data of its tile.
    """
    return int(gaussians * gaussian_bytes(pairs) + pixels * (44 + _SPARE * 12))


def row_bytes(scene: Scene) -> int:
    """Return the bytes of one row of the table during training: values, gradients, both moments,
    averages and statistics."""
    columns = [*scene.table.columns().values(), *scene.table.averages.values()]
    return sum(v.element_size() * v[:1].numel() * (4 if v.requires_grad else 1) for v in columns) + 4 * (2 + 2 * scene.K)


def anchor_cap(scene: Scene, cap: int, max_memory: float, largest: Largest) -> int:
    """Return the current limit on the number of anchors; 0 means no limit.

    The memory of the process above `largest.level` is assumed to grow with the number of rows,
    which is the worst case: some of it does not grow. Each edit may fill half of what is left below
    92 % of the limit, because later frames can be larger and because freed memory is not always
    used again. The next edit measures again.

    Args:
        scene: The scene.
        cap: The limit that the user set; 0 means no limit.
        max_memory: Limit on the memory that `peak_bytes` reports, GiB; 0 means no limit.
        largest: What the training has needed so far.
    """
    if max_memory <= 0:
        return cap
    n = len(scene.table)
    expected = expected_bytes(scene, largest)
    share = largest.gaussians / max(n, 1)
    least = 3 * row_bytes(scene) + share * gaussian_bytes()  # 3: an edit holds old and new columns at once, and a save copies them
    room = max(0, int((_FILLED * max_memory * 2**30 - expected) / 2 / max(least, (expected - largest.level) / max(n, 1))))
    return min(n + room, cap) if cap else max(n + room, 1)


def expected_bytes(scene: Scene, largest: Largest) -> int:
    """Return the peak that a training is expected to reach if its table does not grow.

    It is the largest of three: the measured peak with the Gaussians of visible rows that were
    transparent in every frame so far; what the process holds now with the buffers of a search for
    new rows (later searches need as much for each row as the last one); and what it holds now with
    the copy of the state that a save or an export makes.
    """
    n, used, rate = len(scene.table), used_bytes(scene.table.device), _SEARCHED * scene.K
    transparent = max(0, largest.rows * scene.K - largest.gaussians)
    frame = peak_bytes(scene.table.device) + int(transparent * gaussian_bytes())
    search = largest.level + (largest.searching - largest.level) * n // largest.searched if largest.searched else used + rate * n
    return max(frame, search, used + row_bytes(scene) * n * 3 // 4)


def check_start(scene: Scene, begun: bool, max_memory: float, largest: Largest, images: int = 0) -> None:
    """Raise InputError if a training cannot begin within `max_memory` GiB (0: no limit).

    Args:
        scene: The scene at the start.
        begun: Whether the moments are already there, as in a resumed training.
        max_memory: Limit on the memory that `peak_bytes` reports, GiB.
        largest: What trial views have needed; before any of them, the frame counts as one Gaussian
            for each row.
        images: Bytes that the cache of the photographs will still take.
    """
    if max_memory <= 0:
        return
    learned = sum(v.element_size() * v.numel() for v in scene.table.params.values())
    if largest.gaussians:  # the gradients are part of the peak
        needed = expected_bytes(scene, largest) + images + (0 if begun else 2 * learned)
    else:
        needed = max(peak_bytes(scene.table.device), used_bytes(scene.table.device) + learned * (1 if begun else 3))
        needed += frame_bytes(len(scene.table), 0)
    if needed > max_memory * 2**30:
        raise InputError(
            f"expected a start within --max-memory {max_memory:g} GiB, found {len(scene.table):,} {scene.traits.rows} that need about "
            f"{needed / 2**30:.2f} GiB; raise --max-memory, start from fewer points or lower --resolution"
        )


def used_bytes(device: torch.device) -> int:
    """Return the memory of this process, bytes: reserved GPU memory for CUDA, else resident memory.
    0 if the system does not report it."""
    if device.type == "cuda":
        return torch.cuda.memory_reserved(device)
    try:
        return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")
    except (OSError, ValueError, IndexError, AttributeError):
        return _most_used()


def peak_bytes(device: torch.device) -> int:
    """Return the peak of `used_bytes` since `forget_peak`, or since the process began. 0 if the
    system does not report it."""
    if device.type == "cuda":
        return torch.cuda.max_memory_reserved(device)
    with suppress(OSError, ValueError):
        for line in Path("/proc/self/status").read_text().splitlines():
            if line.startswith("VmHWM:"):
                return 1024 * int(line.split()[1])
    return max(_most_used(), used_bytes(device))


def forget_peak() -> None:
    """Let `peak_bytes` begin anew in a process that has done other work, where the system allows
    it."""
    if torch.cuda.is_initialized():
        torch.cuda.reset_peak_memory_stats()
    with suppress(OSError):
        Path("/proc/self/clear_refs").write_text("5")


def _most_used() -> int:
    """Return the peak resident memory of this process, bytes, for systems that report only the peak
    (macOS). 0 if unknown."""
    try:
        import resource
    except ImportError:
        return 0
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * (1 if sys.platform == "darwin" else 1024)


def reuse_freed() -> bool:
    """Let the C library keep up to 256 MiB of freed memory for reuse instead of returning it to the
    system.

    Each iteration allocates new gradients. With a million Gaussians, page faults of new memory took
    a quarter of its time.

    Returns:
        Whether the setting is active. It is not if the C library is not glibc, or if environment
        variables configure malloc.
    """
    if not sys.platform.startswith("linux") or any(name.startswith("MALLOC_") for name in os.environ) or "GLIBC_TUNABLES" in os.environ:
        return False
    try:
        mallopt = ctypes.CDLL(None).mallopt
    except (OSError, AttributeError):
        return False
    return bool(mallopt(_MMAP_THRESHOLD, _LARGE)) and bool(mallopt(_TRIM_THRESHOLD, _KEPT))


def give_back() -> None:
    """Return freed memory to the system, where the C library can, instead of keeping it for
    reuse."""
    if not sys.platform.startswith("linux"):
        return
    with suppress(OSError, AttributeError):
        ctypes.CDLL(None).malloc_trim(0)
