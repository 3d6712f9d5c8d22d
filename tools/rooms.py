"""Shows the way of one command through the package: which of our modules run, in which order, and how
often control enters one.

    python tools/rooms.py export RUN --format compact --out FILE
    python tools/rooms.py export RUN --format ply --no-measure --refine 3 --out FILE

The command runs in this process under `sys.setprofile`. Everything counts from the moment the command
line has been parsed. A module is visited when one of its functions runs. Importing a module is no visit,
and neither is a constructor that `dataclass` generates: it has no source to read. A step in is a call from
another module of ours; a step out is the return. Threads are not followed.

Some work is done behind a door: one function that the caller calls and whose inside it need not know (see
DOORS). The last lines give the number of modules on the way itself, behind each door, and in all. The exit
code is the command's.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import dataclass, field
from types import FrameType
from typing import Any

PACKAGE = "scene_experts"
PARSER = (f"{PACKAGE}.arguments.parse", "parse")
DOORS = {
    ("training.run_folder", "open_run"): "opening the run and its capture",
    ("training.run_folder", "with_capture"): "opening the run and its capture",
    ("training.run_folder", "capture_of"): "opening the run and its capture",
    ("files.measure", "capture_if_there"): "opening the run and its capture",
    ("files.bake.bake", "bake"): "baking",
    ("files.measure", "cost"): "measuring",
    ("core.reading.plain", "read_json"): "checking what is read and written",
    ("core.reading.numbers", "all_finite"): "checking what is read and written",
}
ITSELF = "on the way itself"


@dataclass
class Walk:
    """Records visits while it is the profile function."""

    entered: dict[str, int] = field(default_factory=dict)  # module -> steps into it, in order of the first
    behind: dict[str, set[str]] = field(default_factory=dict)  # door -> modules visited there
    path: list[tuple[FrameType, str, str]] = field(default_factory=list)  # our calls under way: frame, module, door
    importing: FrameType | None = None
    parsed: bool = False

    @property
    def steps(self) -> int:
        """Steps into modules and out of them."""
        return 2 * sum(self.entered.values())

    def __call__(self, frame: FrameType, event: str, argument: Any) -> None:
        if event not in ("call", "return"):
            return
        if not self.parsed:
            self.begin(frame, event)
        elif self.importing is not None:
            self.importing = None if event == "return" and frame is self.importing else self.importing
        elif event == "return":
            if self.path and self.path[-1][0] is frame:
                self.path.pop()
        elif frame.f_code.co_name == "<module>":
            self.importing = frame
        else:
            self.visit(frame)

    def begin(self, frame: FrameType, event: str) -> None:
        """Start with the function that called the parser, once the parser returns."""
        if event == "return" and (frame.f_globals.get("__name__"), frame.f_code.co_name) == PARSER:
            self.parsed = True
            if frame.f_back is not None:
                self.visit(frame.f_back)

    def visit(self, frame: FrameType) -> None:
        code, module = frame.f_code, frame.f_globals.get("__name__", "")
        if not f"{module}.".startswith(f"{PACKAGE}.") or code.co_filename.startswith("<"):
            return
        _, before, door = self.path[-1] if self.path else (None, "", ITSELF)
        if before != module:
            self.entered[module] = self.entered.get(module, 0) + 1
        if door == ITSELF:
            door = DOORS.get((module.removeprefix(f"{PACKAGE}."), code.co_name), ITSELF)
        self.behind.setdefault(door, set()).add(module)
        self.path.append((frame, module, door))


def follow(command: Callable[[], int]) -> tuple[int, Walk]:
    """Run a command; its exit code and its walk."""
    walk = Walk()
    sys.setprofile(walk)
    try:
        return command(), walk
    finally:
        sys.setprofile(None)


def main() -> int:
    from scene_experts.cli import main as run

    code, walk = follow(lambda: run(sys.argv[1:]))
    width = max(map(len, walk.entered), default=0)
    itself = walk.behind.get(ITSELF, set())
    for number, (module, count) in enumerate(walk.entered.items(), 1):
        doors = ", ".join(door for door, modules in walk.behind.items() if module in modules)
        print(f"{number:>3}  {module:<{width}}  entered {count:>5} times  {doors}")
    for door, modules in walk.behind.items():
        more = "" if door == ITSELF else f", {len(modules - itself)} of them nowhere on the way itself"
        print(f"{len(modules):>3} modules {door}{more}")
    print(f"{len(walk.entered):>3} modules in all, {walk.steps} steps in and out")
    return code


if __name__ == "__main__":
    sys.exit(main())
