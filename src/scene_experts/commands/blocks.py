"""`scene-experts blocks`: plan blocks of a large capture, and merge their runs."""

from __future__ import annotations

import shlex
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from scene_experts.arguments.option import Option
from scene_experts.arguments.parse import HELP, HELP_ALL, Command, HelpAsked, parse
from scene_experts.commands import PROG
from scene_experts.core.errors import InputError, nearest
from scene_experts.data.settings import Data

ABOUT = f"""usage: {PROG} blocks plan CAPTURE --out PLAN [options]
       {PROG} blocks merge PLAN --runs RUN... --out RUN [options]

Train a scene that is too large for one run in blocks.

plan: divide a capture into blocks and write the commands that train them.
merge: merge the runs of the blocks into one run.

`{PROG} blocks plan --help` and
`{PROG} blocks merge --help` show the options."""


@dataclass(frozen=True)
class PlanCommand:
    """Divide a capture into blocks with equal numbers of points, choose the views of each block, and write the commands that train a
    coarse scene, the blocks and the merged scene."""

    data: Annotated[Data, Option(name="")]
    out: Annotated[Path, Option(value="PLAN")]
    """Folder to write: plan.json, the views of each block and commands.sh."""
    blocks: int = 4
    """Number of blocks."""
    margin: float = 0.1
    """Choose views by the points in a block and around it, up to this share of its size."""
    share: float = 0.1
    """A view belongs to a block if at least this share of the points in its picture lie in the enlarged block."""
    recipe: str = "moe-gs"
    """Recipe of the commands; a recipe with anchors."""
    iterations: int = 30_000
    """Iterations of the commands: a third for the coarse scene, the others for each block, and a tenth more for the merged scene."""


@dataclass(frozen=True)
class MergeCommand:
    """Merge the runs of blocks into one run. Each anchor comes from the block that it lies in."""

    plan: Annotated[Path, Option(value="PLAN")]
    """Folder of the plan."""
    runs: Annotated[tuple[Path, ...], Option(value="RUN")]
    """Run folders of the blocks, in the order of the plan."""
    out: Annotated[Path, Option(short="-m", value="RUN")]
    """Run folder to write."""


def blocks(args: list[str]) -> int:
    actions = {"plan": plan, "merge": merge}
    if not args or args[0] in (*HELP, HELP_ALL):
        if args:
            raise HelpAsked(ABOUT)
        raise InputError(f"expected plan or merge after `{PROG} blocks`, found none; see `{PROG} blocks --help`")
    if args[0] not in actions:
        raise InputError(f"expected plan or merge after `{PROG} blocks`, found '{args[0]}'{nearest(args[0], actions)}; change it")
    return actions[args[0]](args[1:])


def plan(args: list[str]) -> int:
    """Write a plan and print its commands."""
    command = parse(PlanCommand, Command(f"{PROG} blocks plan", ("--data",)), args)

    from scene_experts.core.io import write_bytes
    from scene_experts.data.blocks import make_blocks, write_plan
    from scene_experts.recipes import RECIPES
    from scene_experts.training import run_folder

    if command.data.views is not None:
        raise InputError(f"expected a plan of all training views, found --views {command.data.views}; leave it out")
    if command.recipe not in RECIPES:
        raise InputError(f"expected a recipe as --recipe, found '{command.recipe}'{nearest(command.recipe, RECIPES)}; change it")
    capture = run_folder.load_capture(run_folder.named(command.data))
    capture.images.close()
    found = make_blocks(capture, command.blocks, command.margin, command.share)
    write_plan(command.out, capture, found)
    lines = commands(command, [block.bounds for block in found])
    write_bytes(command.out / "commands.sh", ("#!/bin/sh\nset -e\n" + "\n".join(lines) + "\n").encode())
    for number, block in enumerate(found):
        print(f"block {number}: {len(block.views)} of {len(capture.train)} training views")
    print(f"wrote {command.out}; the blocks can be trained at the same time:", *lines, sep="\n")
    return 0


def commands(command: PlanCommand, bounds: list[tuple[float, ...]]) -> list[str]:
    """The commands that train a coarse scene, the blocks, and the merged scene.

    bounds: corners of the box of each block with its margin, in trained world units.
    """
    out, total = command.out, command.iterations
    data = [word for name, value in vars(command.data).items() if value != getattr(Data(Path()), name) for word in _flag(name, value)]
    train = [PROG, "train", command.recipe, *data]
    coarse, merged = str(out / "coarse"), str(out / "merged")
    runs = [str(out / f"run{number}") for number in range(command.blocks)]
    lines = [[*train, "--out", coarse, "--iterations", str(total), "--stop-at", str(max(1, total // 3))]]
    for number, run in enumerate(runs):
        views = ["--views", str(out / f"block{number}.json"), "--init-from", coarse, "--rates.networks", "0"]
        inside = ["--growth.bounds", *(f"{side:.6g}" for side in bounds[number])]
        lines.append([*train, "--out", run, "--iterations", str(total), *views, *inside])
    lines.append([PROG, "blocks", "merge", str(out), "--runs", *runs, "--out", merged])
    lines.append([*train, "--out", str(out / "joint"), "--iterations", str(total + max(1, total // 10)), "--init-from", merged])
    return [shlex.join(line) for line in lines]


def _flag(name: str, value: object) -> list[str]:
    words = [str(item) for item in value] if isinstance(value, tuple) else [] if value is True else [str(value)]
    return [f"--{'data' if name == 'path' else name.replace('_', '-')}", *words]


def merge(args: list[str]) -> int:
    """Merge runs and print where the merged run is."""
    command = parse(MergeCommand, Command(f"{PROG} blocks merge", ("--plan",)), args)

    from scene_experts.files.merging import merge_blocks

    count = merge_blocks(command.plan, command.runs, command.out)
    print(f"wrote {command.out}: {count:,} anchors from {len(command.runs)} blocks")
    print(f"next: {shlex.join([PROG, 'eval', str(command.out)])}")
    return 0
