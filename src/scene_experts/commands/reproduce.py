"""`scene-experts reproduce`: the paper's tables and figures."""

from __future__ import annotations

from scene_experts.arguments.parse import Command, parse
from scene_experts.commands import PROG
from scene_experts.reproduce.options import ReproduceOptions

FIRST = (
    "captures",
    "data",
    "scenes",
    "recipes",
    "baseline",
    "seeds",
    "iterations",
    "resolution",
    "scale",
    "out",
    "workers",
    "devices",
    "dry-run",
    "tables-only",
)
"""The options that people use first, for --help."""


def reproduce(args: list[str]) -> int:
    options = parse(ReproduceOptions, Command(f"{PROG} reproduce", ("experiments",), FIRST), args)

    from rich.console import Console

    from scene_experts.reproduce.session import reproduce as run

    console = Console(markup=False, highlight=False)
    complete = run(options, lambda text: console.print(text, soft_wrap=True, markup=False))
    return 0 if complete else 130
