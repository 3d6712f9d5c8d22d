"""Caches decoded frames within a memory limit, and decodes frames ahead in other threads.

Decoding depends on the files only, so the content of a frame never depends on the cache or on the
timing of the threads.
"""

from __future__ import annotations

import os
import threading
import weakref
from collections import OrderedDict, deque
from collections.abc import Iterable
from contextlib import suppress
from pathlib import Path

from torch import Tensor

from scene_experts.data.images import FrameSource, decode

Decoded = tuple[Tensor, Tensor | None]  # rgb [H, W, 3] uint8, mask [H, W] uint8 or None


def available_bytes() -> int | None:
    """Return the memory in bytes that this process may still allocate, or None if the system does
    not tell.

    It is the smaller of what the machine and the control group leave free. File pages held by a
    control group count as free, as they do in MemAvailable, because the kernel reclaims them on
    demand.
    """
    left = []
    with suppress(OSError, ValueError, KeyError):
        left.append(1024 * _read_numbers("/proc/meminfo")["MemAvailable:"])
    group = Path("/sys/fs/cgroup")
    for limit, used, stat, files in (
        ("memory.max", "memory.current", "memory.stat", "inactive_file"),
        ("memory/memory.limit_in_bytes", "memory/memory.usage_in_bytes", "memory/memory.stat", "total_inactive_file"),
    ):
        with suppress(OSError, ValueError):  # absent, or "max": no limit
            free = int(_read(group / limit)) - int(_read(group / used))
            with suppress(OSError, ValueError, KeyError):
                free += _read_numbers(group / stat)[files]
            left.append(max(0, free))
    if not left and hasattr(os, "sysconf") and "SC_AVPHYS_PAGES" in os.sysconf_names:
        left.append(os.sysconf("SC_AVPHYS_PAGES") * os.sysconf("SC_PAGE_SIZE"))
    return min(left) if left else None


def _read(path: Path | str) -> str:
    return Path(path).read_text()


def _read_numbers(path: Path | str) -> dict[str, int]:
    """Read numbers by name from lines such as "MemAvailable: 123 kB"."""
    return {words[0]: int(words[1]) for line in _read(path).splitlines() if len(words := line.split()) > 1}


class _Cache:
    """The state that the threads share. It is separate from ImageStore so that the threads do not
    keep the store alive."""

    def __init__(self, sources: tuple[FrameSource, ...], budget: int) -> None:
        self.sources, self.budget, self.used = sources, budget, 0
        self.frames: OrderedDict[int, Decoded] = OrderedDict()  # least recently used first
        self.wanted: deque[int] = deque()
        self.ahead: set[int] = set()  # frames of the last prefetch, decoded or not
        self.busy: set[int] = set()
        self.changed = threading.Condition()
        self.stopped = False

    def get(self, index: int) -> Decoded:
        with self.changed:
            while index in self.busy:  # another thread is decoding it
                self.changed.wait()
            if index in self.frames:
                self.frames.move_to_end(index)
                self.ahead.discard(index)
                return self.frames[index]
            self.busy.add(index)
        try:
            frame = decode(self.sources[index])
        except BaseException:
            with self.changed:
                self.busy.discard(index)
                self.changed.notify_all()
            raise
        with self.changed:
            self.busy.discard(index)
            self._insert(index, frame)
            self.changed.notify_all()
        return frame

    def _insert(self, index: int, frame: Decoded) -> None:
        size = _count_bytes(frame)
        fits = size <= self.budget
        room = self.budget - size if fits else self.budget
        while self.used > room:  # before it is added: `used` is read without the lock and must not exceed the budget
            self.used -= _count_bytes(self.frames.pop(self._choose_victim()))
        if fits:
            self.frames[index] = frame
            self.used += size

    def _choose_victim(self) -> int:
        """Choose the frame to drop: the most recently used one that is not prefetched.

        Training sees every view once per epoch, so this frame is needed last. With a cache for half
        of the frames, the hit rate is 50 %; dropping the least recently used frame gives 12 %.
        """
        free = (index for index in reversed(self.frames) if index not in self.ahead)
        return next(free, next(iter(self.frames)))

    def decode_ahead(self) -> None:
        """Decode the wanted frames in order until stopped; runs in each thread. `get` reports files
        that cannot be decoded."""
        while True:
            with self.changed:
                while not self.wanted and not self.stopped:
                    self.changed.wait()
                if self.stopped:
                    return
                index = self.wanted.popleft()
                if index in self.frames or index in self.busy:
                    continue
            try:
                self.get(index)
            except Exception:
                continue


def _count_bytes(frame: Decoded) -> int:
    return sum(part.numel() for part in frame if part is not None)


def _stop(cache: _Cache, threads: list[threading.Thread]) -> None:
    with cache.changed:
        cache.stopped = True
        cache.wanted.clear()
        cache.changed.notify_all()
    for thread in threads:
        if thread is not threading.current_thread():
            thread.join(timeout=30)


class ImageStore:
    """Frames by index, decoded on first use and cached within `cache_bytes`.

    Args:
        sources: One source per frame.
        cache_bytes: Memory for decoded frames. None is a third of `available_bytes()`, or of 4 GiB
            if that is unknown.
    """

    sources: tuple[FrameSource, ...]
    cache_bytes: int

    def __init__(self, sources: Iterable[FrameSource], cache_bytes: int | None = None) -> None:
        self.sources = tuple(sources)
        if cache_bytes is None:
            free = available_bytes()
            cache_bytes = (4 << 30 if free is None else free) // 3
        self.cache_bytes = max(0, int(cache_bytes))
        self._cache = _Cache(self.sources, self.cache_bytes)
        self._threads: list[threading.Thread] = []

    def __len__(self) -> int:
        return len(self.sources)

    @property
    def used_bytes(self) -> int:
        """Size in bytes of the cached frames, never above `cache_bytes`."""
        return self._cache.used

    def count_bytes(self, indices: Iterable[int]) -> int:
        """Return the size in bytes of these frames, decoded or not."""
        return sum(self.sources[index].bytes for index in indices)

    def limit(self, cache_bytes: int) -> None:
        """Lower `cache_bytes`. Frames beyond it are dropped when the next frame is decoded."""
        with self._cache.changed:
            self.cache_bytes = self._cache.budget = max(0, min(cache_bytes, self.cache_bytes))

    def get(self, index: int) -> Decoded:
        """Return rgb [H, W, 3] uint8 and the mask [H, W] uint8 (255 = counts) or None. The tensors
        are shared: do not modify them.

        Raises InputError if a file is unreadable or has changed its size.
        """
        return self._cache.get(index)

    def prefetch(self, indices: Iterable[int], threads: int = 1) -> None:
        """Decode these frames in the background, in this order. They replace the frames of the
        previous call.

        At most half of the cache is filled; nothing is done if it has room for fewer than two
        frames.

        threads: Number of threads that decode. The store has at least as many as any call has asked
        for.
        """
        room, wanted = self.cache_bytes // 2, []
        for index in dict.fromkeys(indices):
            room -= self.sources[index].bytes
            if room < 0:
                break
            wanted.append(index)
        if not wanted:
            return
        with self._cache.changed:
            self._cache.ahead = set(wanted)
            self._cache.wanted = deque(index for index in wanted if index not in self._cache.frames)
            if not self._cache.wanted:  # no thread need be woken
                return
            self._cache.changed.notify_all()
        if not self._threads and not self._cache.stopped:
            weakref.finalize(self, _stop, self._cache, self._threads)  # also runs at exit
        while len(self._threads) < threads and not self._cache.stopped:
            self._threads.append(threading.Thread(target=self._cache.decode_ahead, name="scene-experts images", daemon=True))
            self._threads[-1].start()

    def close(self) -> None:
        """Stop the threads. Frames can still be read."""
        _stop(self._cache, self._threads)
        self._threads.clear()
