"""The pretended device, seen from a Python process that runs with it (see device.h)."""

from __future__ import annotations

import ctypes
import os
from pathlib import Path
from typing import Any

from pretended_cuda.start import MARK

COUNTS = (
    *("launches", "triton launches", "uploads", "downloads", "device copies", "fills", "waits", "events", "event queries"),
    *("allocations", "pinned allocations", "linear algebra", "pointer queries", "waited ns"),
)
SPEEDS = ("launch", "copy", "event", "latency", "kernel")
MOST = 64  # answers, and downloads that are remembered


class Counts(ctypes.Structure):
    _fields_ = [(name, ctypes.c_uint64) for name in COUNTS]


class Answers(ctypes.Structure):
    _fields_ = [("values", ctypes.c_int64 * MOST), ("count", ctypes.c_int64), ("next", ctypes.c_int64)]


class Speeds(ctypes.Structure):
    _fields_ = [*((name, ctypes.c_double) for name in SPEEDS), ("clock", ctypes.c_int64)]


class Device:
    """What the device has counted, and what it answers."""

    def __init__(self) -> None:
        self.library = ctypes.CDLL(os.environ[MARK])
        self.library.pretended_take_busy.restype = ctypes.c_double
        self.library.pretended_set_time.argtypes = [ctypes.c_char_p, ctypes.c_double]
        self._counts = Counts.in_dll(self.library, "pretended_counts")
        self._answers = (Answers * 2).in_dll(self.library, "pretended_answers")
        self._downloads = (ctypes.c_uint64 * MOST).in_dll(self.library, "pretended_downloads")
        self._download_count = ctypes.c_uint64.in_dll(self.library, "pretended_download_count")
        self.speeds: Any = Speeds.in_dll(self.library, "pretended_speeds")

    def answer(self, four: list[int], eight: list[int]) -> None:
        """Set the numbers that the next copies of 4 and of 8 bytes bring to the host, in order. The last one repeats."""
        for to, values in zip(self._answers, (four, eight)):
            to.values[: len(values)] = values
            to.count, to.next = len(values), 0
        self._download_count.value = 0

    def counts(self) -> dict[str, int]:
        return {name: getattr(self._counts, name) for name in COUNTS}

    def downloads(self) -> list[int]:
        """Bytes of each copy to the host since the last `answer`, in order."""
        return list(self._downloads[: min(self._download_count.value, MOST)])

    def take_busy(self) -> float:
        """Microseconds that the device has worked since the last call."""
        return self.library.pretended_take_busy()

    def set_times(self, path: Path) -> None:
        """Read the time of kernels, lines "PART OF A NAME microseconds", and make the host wait for the device's clock."""
        for line in path.read_text().splitlines():
            part, _, microseconds = line.rpartition(" ")
            if part:
                self.library.pretended_set_time(part.encode(), float(microseconds))
        self.speeds.clock = 1

    def clear(self) -> None:
        self.library.pretended_clear()

    def report(self) -> None:
        """Print the kernels that were launched since `clear`."""
        self.library.pretended_report()
