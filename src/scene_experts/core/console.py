"""The console of commands that work for long."""

from __future__ import annotations

import signal
import sys
from contextlib import suppress

from rich.console import Console


class LastingConsole(Console):
    """A console whose reader may go away, as in `| head`: the command then ends as by Ctrl-C, which
    saves what it has."""

    def on_broken_pipe(self) -> None:
        """Say so, write nothing more, and interrupt the command."""
        self.quiet = True
        with suppress(SystemExit, OSError, ValueError):  # rich leaves stdout to nobody, where it is a file of the system, and exits
            super().on_broken_pipe()
        print("nothing reads the output any more: the command is interrupted", file=sys.stderr)
        if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:  # as of what a shell starts in the background
            raise KeyboardInterrupt
        signal.raise_signal(signal.SIGINT)
