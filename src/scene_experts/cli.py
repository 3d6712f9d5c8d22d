"""The command line: `scene-experts COMMAND ...`: finds the command and turns errors into exit codes."""

from __future__ import annotations

import logging
import sys
from collections.abc import Sequence
from contextlib import suppress

from scene_experts.core.errors import InputError, RunError, nearest

PROG = "scene-experts"
COMMANDS = {
    "capture": "poses and points of photographs or of a video: a capture to train on",
    "info": "what a capture holds: views, sizes, cameras, points, split, warnings",
    "train": "train a scene on a capture",
    "eval": "render and score the held-out views of a run",
    "compare": "one table of several runs",
    "render": "a camera path through a run, as video or pictures",
    "view": "a run in a browser, drawn here: experts, cameras, photographs beside",
    "report": "one page of runs: curves, views with a slider, experts, commands",
    "export": "write a trained scene to files that viewers and later runs open",
    "import": "make a run folder of a published result or of a file that export writes",
    "reproduce": "the paper's tables and figures, from runs made or reused",
    "bench": "how fast this machine is, in a minute: each part beside a named peer",
    "catalog": "the paper's 17 scenes: sources, sizes, licences, what is on this machine",
    "download": "fetch scenes of the catalog: continued, checked, unpacked",
    "doctor": "which backends work here, why not, what to install",
}


def main(argv: Sequence[str] | None = None) -> int:
    """Run a command; returns the exit code: 0 done, 1 failed, 2 unusable input."""
    try:
        return dispatch(list(sys.argv[1:] if argv is None else argv))
    except BrokenPipeError:  # the reader (`| head`) has seen enough
        with suppress(OSError, ValueError):
            sys.stdout.close()
        return 0


def dispatch(args: list[str]) -> int:
    """Run a command and turn its errors into a sentence and an exit code."""
    if not args or args[0] in ("-h", "--help", "help"):
        print(usage())
        return 0 if args else 2
    if args[0] in ("-V", "--version", "version"):
        from scene_experts import __version__

        print(f"{PROG} {__version__}")
        return 0
    command, rest = args[0], args[1:]
    if command not in COMMANDS:
        print(
            f"error: expected one of {', '.join(COMMANDS)}, found '{command}'{nearest(command, COMMANDS)}; see {PROG} --help",
            file=sys.stderr,
        )
        return 2
    logging.basicConfig(level=logging.WARNING, format="warning: %(message)s")
    try:
        from scene_experts import commands

        expect_no_empty(rest)
        return commands.run(command, rest)
    except InputError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    except RunError as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    except BrokenPipeError:
        raise
    except OSError as error:  # what no part foresaw: a file without permission, a drive that went away
        place = f" at {error.filename}" if error.filename else ""
        print(f"error: expected a file or folder that can be used{place}, found: {error.strerror or error}; check it", file=sys.stderr)
        return 1
    except (MemoryError, RuntimeError) as error:
        if not out_of_memory(error):
            raise
        why = str(error).partition("\n")[0] or "no memory left"
        advice = "lower --max-anchors or --resolution (a saved training goes on with --resume)"
        print(f"error: expected enough memory, found too little ({why}); {advice}", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        print("stopped", file=sys.stderr)
        return 130


def expect_no_empty(args: Sequence[str]) -> None:
    """Raises InputError for an empty value: of a path it would be the current folder, as where a shell's variable is not set."""
    for place, arg in enumerate(args):
        if not arg or (arg.startswith("--") and arg.endswith("=")):
            before = arg or (args[place - 1] if place else "the command")
            raise InputError(f"expected a value after {before}, found an empty one; give one, or leave it out")


def out_of_memory(error: Exception) -> bool:
    """Whether an error is torch's or Python's way to say that an allocation failed. torch has a type of its own for the GPU alone."""
    text = str(error).lower()
    return isinstance(error, MemoryError) or "out of memory" in text or "allocate memory" in text


def entry() -> None:
    """The console script."""
    sys.exit(main())


def usage() -> str:
    """The text of `scene-experts --help`."""
    width = max(len(name) for name in COMMANDS)
    lines = [f"  {name:<{width}}  {text}" for name, text in COMMANDS.items()]
    return "\n".join(
        [
            f"usage: {PROG} COMMAND [options]",
            "",
            "Photographs to compact, sharp 3D scenes.",
            "",
            *lines,
            "",
            f"{PROG} COMMAND --help says more.",
        ]
    )


if __name__ == "__main__":
    entry()
