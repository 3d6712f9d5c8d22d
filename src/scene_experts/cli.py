"""The command line: `scene-experts COMMAND ...`. Finds the command and turns errors into a sentence
and an exit code."""

from __future__ import annotations

import io
import logging
import sys
import warnings
from collections.abc import Sequence
from contextlib import suppress

from scene_experts import commands
from scene_experts.arguments.parse import HelpAsked
from scene_experts.commands import COMMANDS, PROG
from scene_experts.core.errors import InputError, RunError, nearest
from scene_experts.core.reading.source import sentence

SLOW = ("make", "capture", "train", "eval", "render", "view", "export", "import")
"""Commands that load torch before their first line."""
CONTINUED = ("make", "capture", "download")
"""Commands that go on where they were interrupted."""


def main(argv: Sequence[str] | None = None) -> int:
    """Run a command. Returns the exit code: 0 for success, 1 for a failure, 2 for invalid input."""
    if isinstance(sys.stdout, io.TextIOWrapper):  # a name that its encoding cannot write ends no work; so it is for stderr already
        sys.stdout.reconfigure(errors="backslashreplace")
    try:
        return dispatch(list(sys.argv[1:] if argv is None else argv))
    except BrokenPipeError:  # the reader (`| head`) has closed the pipe
        with suppress(OSError, ValueError):
            sys.stdout.close()
        return 0


def dispatch(args: list[str]) -> int:
    """Run a command and turn its errors into a sentence and an exit code."""
    if args[:1] == ["help"] and args[1:2]:
        args = [args[1], "--help"]
    if not args or args[0] in ("-h", "--help", "--help-all", "help"):
        print(usage())
        return 0 if args else 2
    if args[0] in ("-V", "--version", "version"):
        from scene_experts.core.version import __version__

        print(f"{PROG} {__version__}")
        return 0
    command, rest = args[0], args[1:]
    if command not in COMMANDS:
        hint = nearest(command, COMMANDS) or f"; see {PROG} --help"
        print(f"error: expected one of {', '.join(COMMANDS)}, found '{command}'{hint}", file=sys.stderr)
        return 2
    logging.basicConfig(level=logging.WARNING, format="warning: %(message)s")
    warnings.filterwarnings("ignore", module=r"PIL\.")  # about damaged metadata; damaged pixels raise an error
    if command in SLOW and sys.stderr.isatty() and not {"-h", "--help", "--help-all"} & set(rest):
        print("starting ...", end="\r", file=sys.stderr, flush=True)  # torch takes seconds to load; the first line covers this one
    try:
        return commands.run(command, rest)
    except HelpAsked as help_:
        print(help_)
        return 0
    except InputError as error:
        print(f"error: {sentence(error)}", file=sys.stderr)
        return 2
    except RunError as error:
        print(f"error: {sentence(error)}", file=sys.stderr)
        return 1
    except BrokenPipeError:
        raise
    except OSError as error:  # one that no part of the program expects, for example a missing permission
        place = f" {error.filename}" if error.filename else " a file"
        print(f"error: cannot use{place}: {(error.strerror or str(error)).lower()}", file=sys.stderr)
        return 1
    except (MemoryError, RuntimeError) as error:
        if not out_of_memory(error):
            raise
        why = str(error).partition("\n")[0] or "no memory left"
        advice = "lower --max-anchors or --resolution (--resume continues a saved training)"
        print(f"error: expected enough memory, found too little ({why}); {advice}", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        print("stopped" + ("; the same command goes on from there" if command in CONTINUED else ""), file=sys.stderr)
        return 130


def out_of_memory(error: Exception) -> bool:
    """Whether an error means that an allocation failed. torch has an exception type for this only
    on the GPU."""
    text = str(error).lower()
    return isinstance(error, MemoryError) or "out of memory" in text or "allocate memory" in text


def entry() -> None:
    """The console script."""
    sys.exit(main())


def usage() -> str:
    """The text of `scene-experts --help`."""
    width = max(len(name) for name in COMMANDS)
    lines = [f"  {name:<{width}}  {text}" for name, (_, text) in COMMANDS.items()]
    return "\n".join(
        [
            f"usage: {PROG} COMMAND [options]",
            "",
            "Turn photographs into compact, sharp 3D scenes.",
            "",
            *lines,
            "",
            f"`{PROG} COMMAND --help` shows the options of a command.",
        ]
    )


if __name__ == "__main__":
    entry()
