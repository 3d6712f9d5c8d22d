"""Commands that look and change nothing: info, doctor."""

from __future__ import annotations

from typing import Annotated

import tyro
from rich.console import Console

from scene_experts.cli import COMMANDS, PROG
from scene_experts.commands.shared import positional
from scene_experts.data.summary import print_summary
from scene_experts.training import run_folder
from scene_experts.training.config import Data


def info(args: list[str]) -> int:
    data = tyro.cli(
        Annotated[Data, tyro.conf.arg(name="")],
        prog=f"{PROG} info",
        args=positional(args, "--data"),
        description="Say what a capture holds; `info CAPTURE` does too.",
    )
    print_summary(run_folder.load_capture(run_folder.named(data), look=True), Console(highlight=False))
    return 0


def doctor(args: list[str]) -> int:
    from scene_experts.commands import doctor as checks

    tyro.cli(lambda: None, prog=f"{PROG} doctor", args=args, description=COMMANDS["doctor"])
    return checks.run(Console(highlight=False))
