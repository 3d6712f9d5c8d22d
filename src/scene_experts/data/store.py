"""Decoded frames kept in memory within a number of bytes, and decoded ahead by one thread.

What a frame holds never depends on the cache or on the thread's timing: decoding is a pure function of the files.
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

from scene_experts.data.images import Source, decode

Decoded = tuple[Tensor, Tensor | None]  # rgb [H, W, 3] uint8, mask [H, W] uint8 or None


def available_bytes() -> int | None:
    """Memory this process may still take: the least of what the machine and its control group leave. None where neither can be read.

    What a control group holds of files is given back when it is asked for, so it counts as free, as it does in MemAvailable.
    """
    left = []
    with suppress(OSError, ValueError, KeyError):
        left.append(1024 * _facts("/proc/meminfo")["MemAvailable:"])
    group = Path("/sys/fs/cgroup")
    for limit, used, stat, files in (
        ("memory.max", "memory.current", "memory.stat", "inactive_file"),
        ("memory/memory.limit_in_bytes", "memory/memory.usage_in_bytes", "memory/memory.stat", "total_inactive_file"),
    ):
        with suppress(OSError, ValueError):  # absent, or "max": no limit
            free = int(_read(group / limit)) - int(_read(group / used))
            with suppress(OSError, ValueError, KeyError):
                free += _facts(group / stat)[files]
            left.append(max(0, free))
    if not left and hasattr(os, "sysconf") and "SC_AVPHYS_PAGES" in os.sysconf_names:
        left.append(os.sysconf("SC_AVPHYS_PAGES") * os.sysconf("SC_PAGE_SIZE"))
    return min(left) if left else None


def _read(path: Path | str) -> str:
    return Path(path).read_text()


def _facts(path: Path | str) -> dict[str, int]:
    """Numbers by name from lines such as "MemAvailable: 123 kB"."""
    return {words[0]: int(words[1]) for line in _read(path).splitlines() if len(words := line.split()) > 1}


class _Cache:
    """State shared with the thread, apart from ImageStore so that the thread does not keep that alive."""

    def __init__(self, sources: tuple[Source, ...], budget: int) -> None:
        self.sources, self.budget, self.used = sources, budget, 0
        self.frames: OrderedDict[int, Decoded] = OrderedDict()  # least recently used first
        self.wanted: deque[int] = deque()
        self.ahead: set[int] = set()  # of the last prefetch, decoded or not
        self.busy: set[int] = set()
        self.changed = threading.Condition()
        self.stopped = False

    def get(self, index: int) -> Decoded:
        with self.changed:
            while index in self.busy:  # the other thread is decoding it
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
            self._keep(index, frame)
            self.changed.notify_all()
        return frame

    def _keep(self, index: int, frame: Decoded) -> None:
        size = _bytes(frame)
        if size > self.budget:
            return
        self.frames[index] = frame
        self.used += size
        while self.used > self.budget:
            self.used -= _bytes(self.frames.pop(self._spare(index)))

    def _spare(self, new: int) -> int:
        """The frame to drop: the last one used, for training sees every view once an epoch, so that one is needed last.

        (Dropping the least recently used would find 12 % of the frames of an epoch in a cache of half of them; this finds half.)
        """
        free = (index for index in reversed(self.frames) if index != new and index not in self.ahead)
        return next(free, next(iter(self.frames)))

    def work(self) -> None:
        """The thread: decode what is wanted, in order, until stopped. A bad file is left for `get` to report."""
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


def _bytes(frame: Decoded) -> int:
    return sum(part.numel() for part in frame if part is not None)


def _stop(cache: _Cache, thread: threading.Thread | None) -> None:
    with cache.changed:
        cache.stopped = True
        cache.wanted.clear()
        cache.changed.notify_all()
    if thread is not None and thread is not threading.current_thread():
        thread.join(timeout=30)


class ImageStore:
    """Frames by index, decoded when first asked for and kept within `cache_bytes`.

    What was used last and is not prefetched for later is dropped first.

    `cache_bytes` None: a third of `available_bytes`, or of 4 GiB where the system does not tell.
    """

    def __init__(self, sources: Iterable[Source], cache_bytes: int | None = None) -> None:
        self.sources = tuple(sources)
        if cache_bytes is None:
            free = available_bytes()
            cache_bytes = (4 << 30 if free is None else free) // 3
        self.cache_bytes = max(0, int(cache_bytes))
        self._cache = _Cache(self.sources, self.cache_bytes)
        self._thread: threading.Thread | None = None

    def __len__(self) -> int:
        return len(self.sources)

    @property
    def used_bytes(self) -> int:
        """Bytes of the frames kept now, never above `cache_bytes`."""
        return self._cache.used

    def get(self, index: int) -> Decoded:
        """rgb [H, W, 3] uint8 and mask [H, W] uint8 (255 = counts) or None. The tensors are shared: do not write to them.

        Raises InputError for a file that is unreadable or changed its size.
        """
        return self._cache.get(index)

    def prefetch(self, indices: Iterable[int]) -> None:
        """Decode these frames in the background, in this order, in place of what was asked for before.

        As many as half the cache holds; with less than two frames' room nothing is done.
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
            self._cache.wanted = deque(wanted)
            self._cache.ahead = set(wanted)
            self._cache.changed.notify_all()
        if self._thread is None and not self._cache.stopped:
            self._thread = threading.Thread(target=self._cache.work, name="scene-experts images", daemon=True)
            self._thread.start()
            weakref.finalize(self, _stop, self._cache, self._thread)  # also runs at exit

    def close(self) -> None:
        """Stop the thread; frames can still be read."""
        _stop(self._cache, self._thread)
        self._thread = None
