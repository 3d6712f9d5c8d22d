"""What ends a command from outside: signals, and the end of the process that started it."""

from __future__ import annotations

import os
import signal
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

PARENT = "SCENE_EXPERTS_PARENT"
"""Environment variable with the number of the process that a command must not outlive; `reproduce` sets it for its runs."""


def ending() -> list[signal.Signals]:
    """Ctrl-C's signal, SIGTERM, and that of a closed terminal, unless somebody has it ignored (`nohup`)."""
    out = [signal.SIGINT, signal.SIGTERM]
    if hasattr(signal, "SIGHUP") and signal.getsignal(signal.SIGHUP) is not signal.SIG_IGN:  # Windows has none
        out.append(signal.SIGHUP)
    return out


@contextmanager
def handled(handler: Callable[[int, object], None]) -> Iterator[None]:
    """Call `handler` on the signals that end a command; afterwards they do what they did before."""
    previous = {number: signal.signal(number, handler) for number in ending()}
    try:
        yield
    finally:
        for number, before in previous.items():
            signal.signal(number, before)


def follow_parent(every: float = 1.0) -> None:
    """End by SIGTERM, which saves, once the process that PARENT names is no longer this one's parent: it was killed."""
    parent = os.environ.pop(PARENT, "")
    if not parent.isdecimal() or os.getppid() != int(parent):
        return

    def watch() -> None:
        while os.getppid() == int(parent):
            time.sleep(every)
        os.kill(os.getpid(), signal.SIGTERM)

    threading.Thread(target=watch, daemon=True).start()
