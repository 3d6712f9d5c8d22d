"""The machine: its processor, and what it can do at most."""

from __future__ import annotations

import platform
from dataclasses import dataclass
from pathlib import Path

import torch

from scene_experts.bench import peer
from scene_experts.bench.measure import Clock, clock_for, least
from scene_experts.native import library as native

CHUNKS = 100  # of the arithmetic loop, about a millisecond


@dataclass(frozen=True)
class Machine:
    """What the figures are measured on. Rates are of one thread; None where the compiled libraries that measure them are absent."""

    processor: str
    cores: int  # that this process may use
    threads: int  # used where a figure says "all threads"
    level: str | None  # instruction set of the compiled library in use
    levels: tuple[str, ...]  # that this processor runs and that are installed
    torch: str
    clock_hz: float | None = None
    multiply_adds: float | None = None  # of single floats, a second
    copied: float | None = None  # bytes read and written a second by a large copy


def describe(threads: int) -> Machine:
    """The machine without its rates."""
    cores = native.count_cores()
    library = native.load()
    installed = tuple(level for level in native.list_levels() if native.find(level))
    return Machine(processor(), cores, threads, getattr(library, "level", None), installed, torch.__version__)


def processor() -> str:
    """The processor's name, as the system tells it."""
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        lines = []
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.processor() or platform.machine()


def multiply_adds(level: str | None, threads: int, seconds: float, clock: Clock | None = None) -> float | None:
    """Multiply-adds of single floats a second by a native loop that waits for nothing; None where no library has it.

    clock: processor time for one thread and wall time for more, unless given.
    """
    library = native.load(level)
    if library is None:
        return None
    done = 0.0

    def loop(clock: Clock) -> tuple[float]:
        nonlocal done
        began = clock()
        done = library.se_benchmark_multiply_adds(CHUNKS * threads, threads)
        return (clock() - began,)

    best = least({"loop": loop}, seconds, clock or clock_for(threads))["loop"][0]
    return done / best if best > 0 else None


def clock_hz(level: str | None, seconds: float) -> float | None:
    """Core cycles a second, the fastest seen; None without the peer's library."""
    found = peer.load(level)
    if found is None:
        return None
    return 1 / least({"clock": lambda _: (1 / found.clock_hz(),)}, seconds, clock_for(1))["clock"][0]


def copied(seconds: float) -> float:
    """Bytes a second, read and written both counted, that one thread copies between arrays beyond the caches."""
    source = torch.ones(64 * 2**18)
    target = torch.empty_like(source)

    def copy(clock: Clock) -> tuple[float]:
        began = clock()
        target.copy_(source)
        return (clock() - began,)

    return 2 * source.numel() * 4 / least({"copy": copy}, seconds, clock_for(1))["copy"][0]
