"""Shows the way of one command through the package: which of our modules run, in which order, and how often control enters one.

    python tools/rooms.py export RUN --format compact --out FILE
    python tools/rooms.py export RUN --format ply --no-measure --refine 0 --out FILE

The command runs in this process under `sys.setprofile`. Everything counts from the moment the command line has been parsed. A module is
visited when one of its functions runs. Importing a module is no visit, and neither is a constructor that `dataclass` generates: it has no
source to read. A step in is a call from another module of ours; a step out is the return. Threads are not followed. The exit code is the
command's.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import dataclass, field
from types import FrameType
from typing import Any

from scene_experts.arguments import parse as arguments

PACKAGE = "scene_experts"


@dataclass
class Walk:
    """Records visits while it is the profile function."""

    entered: dict[str, int] = field(default_factory=dict)  # module -> steps into it, in order of the first
    path: list[tuple[FrameType, str]] = field(default_factory=list)  # calls under way, of our modules alone
    importing: FrameType | None = None

    @property
    def steps(self) -> int:
        """Steps into modules and out of them."""
        return 2 * sum(self.entered.values())

    def __call__(self, frame: FrameType, event: str, argument: Any) -> None:
        if event not in ("call", "return"):
            return
        if self.importing is not None:
            self.importing = None if event == "return" and frame is self.importing else self.importing
            return
        if event == "return":
            if self.path and self.path[-1][0] is frame:
                self.path.pop()
            return
        code, module = frame.f_code, frame.f_globals.get("__name__", "")
        if code.co_name == "<module>":
            self.importing = frame
        elif f"{module}.".startswith(f"{PACKAGE}.") and not code.co_filename.startswith("<"):
            if not self.path or self.path[-1][1] != module:
                self.entered[module] = self.entered.get(module, 0) + 1
            self.path.append((frame, module))


def followed(command: Callable[[], int]) -> tuple[int, Walk]:
    """Run a command; its exit code and the walk since its options were parsed."""
    walk, make = Walk(), arguments.make

    def make_and_follow(*args: Any) -> Any:
        made = make(*args)
        sys.setprofile(walk)
        return made

    arguments.make = make_and_follow
    try:
        return command(), walk
    finally:
        sys.setprofile(None)
        arguments.make = make


def main() -> int:
    from scene_experts.cli import main as run

    code, walk = followed(lambda: run(sys.argv[1:]))
    width = max(map(len, walk.entered), default=0)
    for number, (module, count) in enumerate(walk.entered.items(), 1):
        print(f"{number:>3}  {module:<{width}}  entered {count:>5} times")
    print(f"{len(walk.entered)} modules, {walk.steps} steps in and out")
    return code


if __name__ == "__main__":
    sys.exit(main())
