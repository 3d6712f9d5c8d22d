"""Stop a command on signals, and when the process that started it has ended."""

from __future__ import annotations

import os
import signal
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

PARENT = "SCENE_EXPERTS_PARENT"
"""Environment variable with the ID of the parent process. The command stops when it ends.
`reproduce` sets it for its runs."""


def ending() -> list[signal.Signals]:
    """Return the signals that end a command: SIGINT, SIGTERM, and SIGHUP unless it is ignored
    (`nohup`)."""
    out = [signal.SIGINT, signal.SIGTERM]
    if hasattr(signal, "SIGHUP") and signal.getsignal(signal.SIGHUP) is not signal.SIG_IGN:  # not on Windows
        out.append(signal.SIGHUP)
    return out


@contextmanager
def handled(handler: Callable[[int, object], None]) -> Iterator[None]:
    """Call `handler` on the signals that end a command. The previous handlers are restored
    afterwards."""
    previous = {number: signal.signal(number, handler) for number in ending()}
    try:
        yield
    finally:
        for number, before in previous.items():
            signal.signal(number, before)


def follow_parent(every: float = 1.0) -> None:
    """Watch the parent process that PARENT names. If it has ended, send SIGTERM to this process,
    which saves and stops.

    `every` is the time between checks, s.
    """
    parent = os.environ.pop(PARENT, "")
    if not parent.isdecimal() or os.getppid() != int(parent):
        return

    def watch() -> None:
        while os.getppid() == int(parent):
            time.sleep(every)
        os.kill(os.getpid(), signal.SIGTERM)

    threading.Thread(target=watch, daemon=True).start()
