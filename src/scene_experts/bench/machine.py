"""The machine: its processor and its peak rates."""

from __future__ import annotations

import hashlib
import platform
import threading
import time
from dataclasses import dataclass
from pathlib import Path

import torch

from scene_experts.bench import peer
from scene_experts.bench.measure import Clock, choose_clock, measure_minima
from scene_experts.native import library as native
from scene_experts.training.clock import load_average

CHUNKS = 100  # chunks of the arithmetic loop: about a millisecond


@dataclass(frozen=True)
class Machine:
    """The machine of the measurements. Rates are for one thread, and None without the compiled
    library that measures them."""

    processor: str
    cores: int  # available to this process
    threads: int  # used for the figures of "all threads"
    level: str | None  # instruction set of the compiled library in use
    levels: tuple[str, ...]  # installed libraries that this processor runs
    torch: str
    clock_hz: float | None = None
    multiply_adds: float | None = None  # of single floats per second
    copied: float | None = None  # bytes read and written per second by a large copy


def describe(threads: int) -> Machine:
    """Describe the machine, without its rates."""
    cores = native.count_cores()
    library = native.load()
    installed = tuple(level for level in native.list_levels() if native.find(level))
    return Machine(read_processor_name(), cores, threads, getattr(library, "level", None), installed, torch.__version__)


def read_processor_name() -> str:
    """Name of the processor as the system reports it."""
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        lines = []
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.processor() or platform.machine()


def measure_share(threads: int, seconds: float = 0.5) -> float:
    """Share of the processor, above 0 to 1, that this many busy threads of this process get beside
    what else runs: now, or by the system's load of the last minute, whichever is more. Takes
    `seconds`."""
    data, until = bytes(1 << 16), time.monotonic() + seconds

    def work() -> None:
        while time.monotonic() < until:
            hashlib.sha256(data).digest()  # releases the interpreter's lock

    began, cpu = time.monotonic(), time.process_time()
    busy = [threading.Thread(target=work) for _ in range(threads)]
    for thread in busy:
        thread.start()
    for thread in busy:
        thread.join()
    now = (time.process_time() - cpu) / (time.monotonic() - began) / threads
    load = load_average()
    return min(1.0, max(0.01, now, 0.0 if load is None else native.count_cores() / (load + threads)))


def measure_multiply_adds(level: str | None, threads: int, seconds: float, clock: Clock | None = None) -> float | None:
    """Multiply-adds of single floats per second in a native loop without dependencies; None without
    a compiled library.

    clock: by default processor time for one thread and wall time for more.
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

    best = measure_minima({"loop": loop}, seconds, clock or choose_clock(threads))["loop"][0]
    return done / best if best > 0 else None


def measure_clock(level: str | None, seconds: float) -> float | None:
    """Largest number of core cycles per second measured; None without the peer's library."""
    found = peer.load(level)
    if found is None:
        return None
    return 1 / measure_minima({"clock": lambda _: (1 / found.clock_hz(),)}, seconds, choose_clock(1))["clock"][0]


def measure_copy(seconds: float) -> float:
    """Bytes per second that one thread reads and writes when it copies an array larger than the
    caches."""
    source = torch.ones(64 * 2**18)
    target = torch.empty_like(source)

    def copy(clock: Clock) -> tuple[float]:
        began = clock()
        target.copy_(source)
        return (clock() - began,)

    return 2 * source.numel() * 4 / measure_minima({"copy": copy}, seconds, choose_clock(1))["copy"][0]
