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
from scene_experts.core.fields import Count, CountOrNone, NotNegative, Pace, flag_of, marked
from scene_experts.data.fetch.catalog import defaults_in, defaults_of
from scene_experts.data.settings import Data

SETTLE = 0.05  # share of the constant rates at the end of the joint training
ABOUT = f"""usage: {PROG} blocks plan CAPTURE --out PLAN [options]
       {PROG} blocks merge PLAN --runs RUN... --out RUN [options]

Train a scene that is too large for one run in blocks.

plan: divide a capture into blocks and write the commands that train them.
merge: merge the runs of the blocks into one run.

`{PROG} blocks plan --help` and
`{PROG} blocks merge --help` show the options."""


PLANNED = ("--out", "--iterations", "--views", "--init-from", "--stop-at", "--growth.bounds", "--rates.anneal", "--rates.anneal-from")
"""Options of the trainings that the plan sets."""


@dataclass(frozen=True)
class PlanCommand:
    """Divide a capture into blocks with equal numbers of points, choose the views of each block,
    and write the commands that train a coarse scene, the blocks and the merged scene."""

    data: Annotated[Data, Option(name="")]
    out: Annotated[Path, Option(value="PLAN")]
    """Folder to write: plan.json, the views of each block and commands.sh."""
    blocks: Count = 4
    """Number of blocks."""
    margin: NotNegative = 0.1
    """Choose views by the points in a block and around it, up to this share of its size."""
    share: NotNegative = 0.1
    """A view belongs to a block if at least this share of the points in its picture lie in the
    enlarged block."""
    recipe: str = "moe-gs"
    """Recipe of the commands; a recipe with anchors."""
    iterations: Count = 30_000
    """Iterations of the commands: a third for the coarse scene, the others for each block, and a
    tenth more for the merged scene."""
    train: Annotated[str, Option(value="OPTIONS")] = ""
    """More options for all trainings, in quotes after =: --train="--scene.voxel-size 0.01 --seed
    1"."""
    coarse_anchors: CountOrNone = 0
    """Maximum number of anchors of the coarse scene; 0 means no limit. Each block holds the coarse
    scene beside its own anchors."""
    max_memory: NotNegative = 0.0
    """Stop densification in the coarse scene and in each block at this resident memory in GiB; 0
    means no limit."""


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
    brought = {"data.normalise": defaults_in(args).normalise}
    command = parse(PlanCommand, Command(f"{PROG} blocks plan", ("data",), defaults=brought), args)

    from scene_experts.core.io import write_bytes
    from scene_experts.data import capture as captures
    from scene_experts.data.blocks import make_blocks, write_plan
    from scene_experts.training import run_folder
    from scene_experts.training.recipes import RECIPES

    if command.data.views is not None:
        raise InputError(f"expected a plan of all training views, found --views {command.data.views}; leave it out")
    if command.recipe not in RECIPES:
        raise InputError(f"expected a recipe as --recipe, found '{command.recipe}'{nearest(command.recipe, RECIPES)}; change it")
    lines = commands(command, [(0.0, 0.0, 0.0, 1.0, 1.0, 1.0)] * command.blocks)  # a wrong option is found before the capture is read
    check_trainings(lines, command.data)
    capture = captures.load(run_folder.named(command.data))
    capture.images.close()
    found = make_blocks(capture, command.blocks, command.margin, command.share)
    write_plan(command.out, capture, found)
    lines = commands(command, [block.bounds for block in found], len(capture.train))
    write_bytes(command.out / "commands.sh", ("#!/bin/sh\nset -e\n" + "\n".join(lines) + "\n").encode())
    for number, block in enumerate(found):
        print(f"block {number}: {len(block.views)} of {len(capture.train)} training views")
    print(f"wrote {command.out}; the blocks can be trained at the same time:", *lines, sep="\n")
    return 0


def commands(command: PlanCommand, bounds: list[tuple[float, ...]], every: int = 0) -> list[str]:
    """The commands that train a coarse scene, the blocks, and the merged scene.

    bounds: corners of the box of each block with its margin, in trained world units.  every:
    training views of the capture. Raises InputError for wrong options of the trainings.
    """
    from scene_experts.api.command_line import changes
    from scene_experts.commands.train import parse_train
    from scene_experts.training.config import flags_of

    out, total, more = command.out, command.iterations, split_words(command.train)
    if planned := [word for word in more if flag_name(word) in PLANNED]:
        raise InputError(f"expected options for --train that the plan leaves open, found {planned[0]}, which it sets; leave it out")
    usual = Data(Path(), normalise=defaults_of(command.data.path).normalise)  # what `train` takes without options
    read = {name: value for name, value in vars(command.data).items() if value != getattr(usual, name)}
    data = options(**{"data" if name == "path" else name: value for name, value in read.items()})
    train = [PROG, "train", command.recipe, *data, *more]
    coarse, merged = out / "coarse", out / "merged"
    runs = [out / f"run{number}" for number in range(command.blocks)]
    memory = options(max_memory=f"{command.max_memory:g}") if command.max_memory else []
    few = options(max_anchors=command.coarse_anchors) if command.coarse_anchors else []
    cfg = parse_train([*train[2:], *options(out=coarse, iterations=total)]).cfg
    until = max(1, total // 3, cfg.scaled_scene().dense_until)  # a scene is divided among experts before it is cut into blocks
    still = [(place, 0) for place in marked(cfg, Pace)]
    own = flags_of(cfg, [*still, *(changes(cfg.scene, cfg.scene.of_views(every), "scene.") or [])])
    block = [PROG, "train", command.recipe, *data, *without(more, [*own[::2], "--rates.networks"])]
    same = [*options(**{"rates.networks": 0}), *own]  # what all anchors share stays equal in all blocks
    lines = [[*train, *options(out=coarse, iterations=total, stop_at=until), *few, *memory]]
    for number, run in enumerate(runs):
        begin = options(out=run, iterations=total, views=out / f"block{number}.json", init_from=coarse)
        inside = options(**{"growth.bounds": tuple(f"{side:.6g}" for side in bounds[number])})
        lines.append([*block, *begin, *same, *inside, *memory])
    lines.append([PROG, "blocks", "merge", str(out), *options(runs=tuple(runs), out=merged)])
    both = total + -(-max(1, total // 10) // cfg.batch) * cfg.batch  # as `total`, a multiple of the batch
    # the rates that a schedule leaves constant fall during the joint training: without it, the
    # blocks' fit is shaken and not restored
    settle = options(**{"rates.anneal": SETTLE, "rates.anneal_from": f"{total / both:.4f}"})
    lines.append([*train, *options(out=out / "joint", iterations=both, init_from=merged), *settle])
    return [shlex.join(line) for line in lines]


def options(**values: object) -> list[str]:
    """Return the arguments that set options, by the dotted paths of their fields."""
    from scene_experts.api.command_line import words_of

    return [word for place, value in values.items() for word in words_of(place, value)]


def flag_name(word: str) -> str:
    """Return the name of the flag that a word of a command is, written with hyphens."""
    return word.partition("=")[0].replace("_", "-") if word.startswith("--") else word


def without(words: list[str], flags: list[str]) -> list[str]:
    """Return the options `words` without these flags and their values."""
    out, given = [], False  # given: the word before was one of the flags
    for word in words:
        here, equals = flag_name(word) in flags, "=" in word
        out += [] if given or here else [word]
        given = not given and here and not equals
    return out


def check_trainings(lines: list[str], data: Data) -> None:
    """Raise InputError if the options of a training in `lines` are wrong, or change how the capture
    `data` of the plan is read."""
    from scene_experts.commands.train import parse_train
    from scene_experts.training.config import check

    for words in map(shlex.split, lines):
        if words[1] == "train":
            train = parse_train(words[2:])
            check(train.cfg)
            for name in (name for name in ("exposure", "refine_poses") if getattr(train.cfg, name)):
                raise InputError(f"expected a training whose blocks can be merged in --train, found {flag_of(name)}; leave it out")
            found = vars(train.data)
            for name in (name for name, value in vars(data).items() if name != "views" and value != found[name]):
                raise InputError(
                    f"expected options of the training in --train, found {flag_of(name)}; give it to `{PROG} blocks plan` itself"
                )


def split_words(text: str) -> list[str]:
    """Split the options of --train as a shell does. Raises InputError for an open quote."""
    try:
        return shlex.split(text)
    except ValueError as error:
        raise InputError(f"expected options for --train, found '{text}' ({error}); correct the quotes") from None


def merge(args: list[str]) -> int:
    """Merge runs and print where the merged run is."""
    command = parse(MergeCommand, Command(f"{PROG} blocks merge", ("plan",)), args)

    from scene_experts.files.merging import merge_blocks

    count = merge_blocks(command.plan, command.runs, command.out)
    print(f"wrote {command.out}: {count:,} anchors from {len(command.runs)} blocks")
    print(f"next: {shlex.join([PROG, 'eval', str(command.out)])}")
    return 0
